"""A page in the browser on which key-points are placed on the moving surface, and follow it at once.

Made with viser (the extra `editor`). All that is edited is in `viz.keypoint_session`; this page shows it and passes on
what the user does. Everybody who opens the page sees and edits the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.keypoints.keypoint_regions import KeyPointFile
from geomocap.model.rig import Rig
from viz.keypoint_marks import BRIDGED, CHOSEN, LINK, MEASURED
from viz.keypoint_panel import Panel
from viz.keypoint_scene import POINTS, Subject, marks_of
from viz.keypoint_session import Follower, Session, pick_ball, pick_surface
from viz.scene_page import ScenePage
from viz.view_shapes import quaternion, vertical_fov

_FIELD_DEG = 32.0  # field of view that the whole motion fills at first


class KeyPointEditor(ScenePage):
    """The page and its server.

    Parameters
    ----------
    subject : Subject
        What is shown.
    follow : Follower
        Moves key-points through time.
    session : Session
        What is edited.
    save : callable
        Saves the key-points and returns a line that says what was written, or raises GeomocapError.
    host : str
        Address to listen on.
    port : int
        The next free one is taken if it is in use.

    Raises
    ------
    MissingPackageError
        If viser isn't installed.
    """

    def __init__(
        self,
        subject: Subject,
        follow: Follower,
        session: Session,
        save: Callable[[KeyPointFile], str],
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        purpose = "Editing key-points in the browser"
        super().__init__("geomocap key-points", host, port, extra="editor", purpose=purpose)
        self.subject, self.follow, self.session, self.save = subject, follow, session, save
        self._dragged: Session | None = None  # as it was when the handles were grabbed
        self._balls: list[tuple[Any, Any]] = []
        self._surface = subject.surface(0)
        self._set_stage()
        self.panel = Panel(self.server.gui, subject)
        self._wire()
        self._draw_frame()
        self._refresh()

    def _pace(self) -> tuple[float, int]:
        return min(self.subject.fps, 15.0), 1

    # --- what the user does ---

    def _wire(self) -> None:
        """Tie the page's elements to edits."""
        panel, edit = self.panel, self._edit
        panel.on("frame", lambda: self._show_frame(panel.frame))
        panel.on("look", self._draw_frame)
        panel.on("chosen", lambda: edit(lambda s: s.choose(panel.chosen)))
        panel.on("name", lambda: edit(lambda s: s.rename(s.chosen or "", panel.name), typing=True))
        panel.on("radius", lambda: edit(lambda s: s.resize(s.chosen or "", panel.radius)))
        panel.on("link", lambda: edit(lambda s: s.link(s.chosen or "", panel.link)))
        panel.on("delete", lambda: edit(lambda s: s.delete(s.chosen or "")))
        panel.on("undo", lambda: edit(Session.undo))
        panel.on("redo", lambda: edit(Session.redo))
        panel.on("save", self._save)
        panel.on("next", lambda: self._step(1))
        panel.on("previous", lambda: self._step(-1))
        panel.on_client("through", self._look_through)

        @self.server.scene.on_click()
        def _(event: Any) -> None:
            with self._lock:
                self._click(np.array(event.ray_origin), np.array(event.ray_direction))

        @self._handles.on_update
        def _(event: Any) -> None:
            with self._lock:
                self._drag(event.phase, np.array(event.target.position))

    def _edit(self, change: Callable[[Session], Session], typing: bool = False) -> None:
        """Change the session, show it, and say what can't be done."""
        with self._lock:
            try:
                self.session = change(self.session)
            except GeomocapError as error:
                self.panel.say(str(error), wrong=True)
                return
            self.panel.say("")
            self._refresh(typing=typing)

    def _click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Choose the key-point that was clicked on, or place one where the surface was."""
        paths = self.follow(self.session.file)
        centers = paths.positions[self.panel.frame]
        radii = np.array([p.radius for p in self.session.file.keypoint])
        ball = pick_ball(centers, radii, origin, direction)
        if ball is not None:
            self._edit(lambda s: s.choose(s.file.names[ball]))
            return
        place = pick_surface(self._surface.points, self._surface.spacing, origin, direction)
        if place is not None:
            self._edit(lambda s: s.place(place, self.panel.frame))

    def _drag(self, phase: str, place: np.ndarray) -> None:
        """Move the chosen key-point with its handles: one step of undo from grab to release."""
        if phase == "start" or self._dragged is None:
            self._dragged = self.session
        before, name = self._dragged, self._dragged.chosen
        if name is None:
            return
        if phase == "end":
            self._dragged = None
        if phase != "start" and np.linalg.norm(place - self._place_of(before, name)) > 1e-6:
            self._edit(lambda _: before.move(name, place, self.panel.frame))
        elif phase == "end":
            self._refresh()

    def _place_of(self, session: Session, name: str) -> np.ndarray:
        place = self.follow(session.file).positions[self.panel.frame, session.file.names.index(name)]
        return np.where(np.isfinite(place), place, np.inf)

    def _save(self) -> None:
        with self._lock:
            try:
                said = self.save(self.session.file)
            except GeomocapError as error:
                self.panel.say(str(error), wrong=True)
            else:
                self.session = self.session.was_saved()
                self.panel.say(said)
            self._refresh()

    def _step(self, by: int) -> None:
        self.panel.frame = (self.panel.frame + by) % self.subject.n_frames
        self._show_frame(self.panel.frame)

    def _show_frame(self, frame: int) -> None:
        with self._lock:
            self._surface = self.subject.surface(frame)
            self._draw_frame()
            self._refresh()

    def _look_through(self, client: Any) -> None:
        """Put a user's view where a camera is."""
        rig = self._rig()
        if rig is None or self.panel.camera not in rig.names:
            return
        c = rig.names.index(self.panel.camera)
        with client.atomic():
            client.camera.wxyz = quaternion(rig.cam_from_world[c, :, :3].T)
            client.camera.position = rig.centers[c]
            client.camera.fov = vertical_fov(rig, c)

    # --- what is shown ---

    def _rig(self) -> Rig | None:
        capture = self.subject.results.capture
        return capture.rig if capture is not None and self.subject.cameras else None

    def _set_stage(self) -> None:
        """Draw what stays: floor, first view, handles, cameras."""
        stage, scene = self.subject.stage, self.server.scene
        view = stage.view(35.0, 12.0, (800, 800), _FIELD_DEG)
        R, t = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
        ahead = np.array([0, 0, t[2]])
        self._begin_at(stage, R.T @ (ahead - t), R.T @ ahead, _FIELD_DEG)
        self._add_grid(stage, stage.centers[0], 12, snapped=True, shadow_opacity=0)
        self._handles = scene.add_transform_controls(
            "/handles", scale=0.08 * stage.diagonal, disable_rotations=True, depth_test=False, visible=False
        )
        self._frusta = {}
        rig = self._rig()
        if rig is not None:
            away = float(np.median(np.linalg.norm(rig.centers - stage.centers[0], axis=1)))
            for c, name in enumerate(rig.names):
                look = {"thickness": 0.002 * away}
                self._frusta[name] = self._add_camera(f"/cameras/{name}", rig, c, 0.12 * away, **look)

    def _draw_frame(self) -> None:
        """Draw what belongs to the frame and not to key-points: surface, trails, pictures in the cameras."""
        frame, panel = self.panel.frame, self.panel
        with self._lock, self.server.atomic():
            self._draw_points("/surface", self._surface, POINTS, 1.15, visible=panel.shows("surface"))
            self._draw_lines("/trails", *self.subject.trails(frame, panel.trails), 2.0)
            for name, frustum in self._frusta.items():
                frustum.visible = panel.shows("cameras")
                if panel.shows("cameras"):
                    frustum.image = self.subject.picture(name, frame, 240)
        self._draw_picture()

    def _refresh(self, typing: bool = False) -> None:
        """Draw the key-points of the frame and fill the panel; the name is left alone while it is typed."""
        with self._lock, self.server.atomic():
            paths = self.follow(self.session.file)
            marks = marks_of(self.session.file, paths, self.session.chosen)
            self._draw_balls(paths.positions[self.panel.frame], paths.bridged[self.panel.frame])
            self._draw_known("/links", marks.positions[self.panel.frame][marks.links], LINK, 3.0)
            self._draw_path(paths.positions, paths.bridged)
            self.panel.fill(self.session, paths, marks, typing=typing)
        self._draw_picture()

    def _draw_balls(self, places: np.ndarray, bridged: np.ndarray) -> None:
        scene, points, stage = self.server.scene, self.session.file.keypoint, self.subject.stage
        while len(self._balls) > len(points):
            for handle in self._balls.pop():
                handle.remove()
        for k in range(len(self._balls), len(points)):
            ball = scene.add_icosphere(f"/keypoints/{k}", 1.0, opacity=0.75, cast_shadow=False)
            label = scene.add_label(f"/names/{k}", "", anchor="bottom-center", font_screen_scale=0.9)
            self._balls.append((ball, label))
        for point, place, carried, (ball, label) in zip(points, places, bridged, self._balls, strict=True):
            known = bool(np.isfinite(place).all())
            chosen = point.name == self.session.chosen
            ball.visible = label.visible = known
            if known:
                ball.position, ball.scale = place, point.radius
                ball.color = BRIDGED if carried else CHOSEN if chosen else MEASURED
                label.position = place + stage.up * 1.15 * point.radius
                label.text = f"{point.name} (bridged)" if carried else point.name
            if chosen and self._dragged is None:
                self._handles.visible = known
                if known:
                    self._handles.position = place
        if self.session.point is None:
            self._handles.visible = False

    def _draw_known(self, name: str, ends: np.ndarray, color: Any, width: float) -> None:
        self._draw_lines(name, ends[np.isfinite(ends).all(axis=(1, 2))], color, width)

    def _draw_path(self, positions: np.ndarray, bridged: np.ndarray) -> None:
        """Draw the way of the chosen key-point through all frames."""
        if self.session.chosen is None:
            self._remove("/path")
            return
        k = self.session.file.names.index(self.session.chosen)
        ends = np.stack([positions[:-1, k], positions[1:, k]], axis=1)
        color = np.where(bridged[1:, k, None], np.array(BRIDGED), np.array(CHOSEN)).astype(np.uint8)
        known = np.isfinite(ends).all(axis=(1, 2))
        self._draw_lines("/path", ends[known], np.repeat(color[known][:, None], 2, axis=1), 3.0)

    def _draw_picture(self) -> None:
        """Draw one camera's picture with the key-points over it."""
        with self._lock:
            if self.panel.camera in self.subject.cameras:
                marks = marks_of(self.session.file, self.follow(self.session.file), self.session.chosen)
                self.panel.picture(self.subject.picture(self.panel.camera, self.panel.frame, 560, marks))
            else:
                self.panel.picture(None)
