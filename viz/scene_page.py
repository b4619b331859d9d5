"""A page with a scene in three dimensions that plays: what the viewer and the key-point editor have in common."""

from __future__ import annotations

import contextlib
import io
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from geomocap.model.rig import Rig
from viz.floor import grid_spacing
from viz.keypoint_scene import SceneSurface
from viz.local_page import serve_page
from viz.view_shapes import quaternion, vertical_fov
from viz.viewpoints import ViewStage


class ScenePage:
    """The page and its server; see `viz.local_page.serve_page` for the parameters."""

    panel: Any

    def __init__(self, label: str, host: str, port: int, *, extra: str, purpose: str) -> None:
        self._lock = threading.RLock()
        self.server = serve_page(label, host, port, extra=extra, purpose=purpose)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def serve(self, wanted: Callable[[], bool] = lambda: True) -> None:
        """Play when asked to, until `wanted` says no or the process is interrupted; then stop the server."""
        try:
            due = time.monotonic()
            while wanted():
                rate, by = self._pace()
                if self.panel.playing:
                    self._step(by)
                due = max(due + 1 / rate, time.monotonic() + 0.005)
                time.sleep(due - time.monotonic())
        finally:
            self.stop()

    def stop(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _pace(self) -> tuple[float, int]:
        """How often a second another frame is shown, and how many frames on."""
        raise NotImplementedError

    def _step(self, by: int) -> None:
        """Go on by some frames."""
        raise NotImplementedError

    # --- what stays ---

    def _begin_at(self, stage: ViewStage, middle: np.ndarray, away: np.ndarray, field_deg: float) -> None:
        """Look at a place first, `away` (3,) from the eye."""
        self.server.scene.set_up_direction(stage.up)
        first = self.server.initial_camera
        first.look_at, first.position = middle, middle - away
        first.up, first.fov = stage.up, np.radians(1.15 * field_deg)

    def _add_grid(self, stage: ViewStage, middle: np.ndarray, cells: float, snapped: bool = False, **look: Any) -> None:
        """Draw the floor below a place, so many cells wide."""
        step = grid_spacing(stage.diagonal)
        plane = {0: "yz", 1: "xz", 2: "xy"}[int(np.argmax(np.abs(stage.up)))]
        base = middle - stage.up * (middle @ stage.up - stage.floor)
        if snapped:
            base = np.where(stage.up > 0.5, base, np.round(base / step) * step)
        self.server.scene.add_grid(
            "/floor", cells * step, cells * step, plane=plane, cell_size=step, section_size=5 * step, position=base,
            **look,
        )  # fmt: skip

    def _add_camera(self, name: str, rig: Rig, c: int, scale: float, **look: Any) -> Any:
        """Draw a camera of a rig."""
        return self.server.scene.add_camera_frustum(
            name, fov=vertical_fov(rig, c), aspect=float(rig.sizes[c, 0] / rig.sizes[c, 1]), scale=scale,
            color=(31, 95, 139), wxyz=quaternion(rig.cam_from_world[c, :, :3].T), position=rig.centers[c], **look,
        )  # fmt: skip

    # --- what a frame shows ---

    def _draw_points(self, name: str, surface: SceneSurface | None, most: int, size: float, **look: Any) -> None:
        """Draw at most so many points of a surface, `size` of their spacing large."""
        if surface is None or not len(surface.points):
            self._remove(name)
            return
        shown = surface.thinned(most).shaded()
        middle = shown.points.mean(axis=0)  # so that half precision is enough
        self.server.scene.add_point_cloud(
            name, shown.points - middle, shown.colors, point_size=size * shown.spacing, point_shape="circle",
            point_shading="flat", position=middle, **look,
        )  # fmt: skip

    def _draw_lines(self, name: str, ends: np.ndarray, colors: Any, width: float) -> None:
        """Draw lines (N, 2, 3), all in one colour or with one at each end, (N, 2, 3)."""
        if len(ends):
            self.server.scene.add_line_segments(name, ends, colors, thickness=width, thickness_units="screen")
        else:
            self._remove(name)

    def _remove(self, name: str) -> None:
        old = self.server.scene.get_handle_by_name(name)
        if old is not None:
            old.remove()
