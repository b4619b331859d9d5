"""What the key-point editor shows of a frame: surface, trails of trajectories, pictures, where key-points are known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from itertools import pairwise

import matplotlib
import numpy as np

from geomocap.keypoints.keypoint_following import KeyPointPaths
from geomocap.keypoints.keypoint_regions import KeyPointFile
from geomocap.model.surface import outward_normals
from viz.body_colors import hex_color
from viz.drawing import resize
from viz.keypoint_marks import BRIDGED, LOST, MEASURED, Marks, marked
from viz.run_contents import Results
from viz.scene import stage as find_stage
from viz.viewpoints import ViewStage
from viz.volumes import spacing

POINTS = 24_000
"""Points of the surface that are drawn at most."""

TRAILS = 1_500
"""Trajectories of which trails are drawn at most."""

TRAIL_FRAMES = 6
"""Frames that a trail goes back."""


_LIGHT = np.array([0.5, -0.6, 0.45])

_STATE_COLORS = (LOST, BRIDGED, MEASURED)  # of `Marks.states`


@dataclass(frozen=True)
class SceneSurface:
    """Points of one frame.

    Attributes
    ----------
    points : (N, 3) float, metres
    colors : (N, 3) uint8
    spacing : float, metres
        Distance of neighbouring points.
    """

    points: np.ndarray
    colors: np.ndarray
    spacing: float

    def shaded(self) -> SceneSurface:
        """Return the points with colours that show the surface's shape: darker where it faces to the side."""
        if len(self.points) < 4:
            return self
        facing = np.abs(outward_normals(self.points) @ (_LIGHT / np.linalg.norm(_LIGHT)))
        bright = 255 * (self.colors / 255) ** 0.75
        return replace(self, colors=np.rint(bright * (0.7 + 0.3 * facing)[:, None]).astype(np.uint8))

    def thinned(self, at_most: int) -> SceneSurface:
        """Return some of the points, the same at every call, spaced accordingly."""
        count = len(self.points)
        if count <= at_most:
            return self
        kept = np.sort(np.random.default_rng(0).permutation(count)[:at_most])
        return SceneSurface(self.points[kept], self.colors[kept], self.spacing * float(np.sqrt(count / at_most)))


@dataclass(frozen=True)
class Subject:
    """A run as the editor shows it.

    Attributes
    ----------
    results : Results
    tracks : (N, T, 3) float, metres
        Trajectories; NaN where not measured.
    fps : float
    """

    results: Results
    tracks: np.ndarray
    fps: float

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.tracks.shape[1]

    @cached_property
    def stage(self) -> ViewStage:
        """Where the motion takes place."""
        return find_stage(self.results)

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Cameras whose pictures can be shown."""
        capture = self.results.capture
        return capture.cameras if capture is not None and capture.is_calibrated else ()

    def surface(self, frame: int) -> SceneSurface:
        """Return the voxels or the cloud of a frame, else the trajectories' points."""
        if self.results.has("voxels", frame):
            v = self.results.voxels(frame)
            return SceneSurface(v.points, v.colors, v.voxel_size)
        if self.results.has("cloud", frame):
            c = self.results.cloud(frame)
            return SceneSurface(c.positions, c.shown_colors, spacing(c.positions))
        points = self.tracks[:, frame]
        points = points[np.isfinite(points[:, 0])]
        return SceneSurface(points, np.full(points.shape, 150, np.uint8), spacing(points))

    # --- trails ---

    @cached_property
    def _shown(self) -> np.ndarray:
        """Trajectories that get trails, (M, T, 3), spread at random."""
        order = np.random.default_rng(0).permutation(len(self.tracks))
        return self.tracks[np.sort(order[:TRAILS])]

    @cached_property
    def top_speed(self) -> float:
        """Speed that has the brightest colour, m/s: few points are faster."""
        speeds = np.linalg.norm(np.diff(self._shown, axis=1), axis=2) * self.fps
        speeds = speeds[np.isfinite(speeds)]
        return max(float(np.percentile(speeds, 98)) if len(speeds) else 0.0, 1e-3)

    def trails(self, frame: int, color_by: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the ways of points over the last frames as segments.

        Parameters
        ----------
        frame : int
        color_by : str
            "speed" or "direction".

        Returns
        -------
        segments : (S, 2, 3) float, metres
        colors : (S, 2, 3) uint8
        """
        first = max(frame - TRAIL_FRAMES, 0)
        way = self._shown[:, first : max(frame + 1, TRAIL_FRAMES + 1)]  # the first frames show what comes
        way = way[np.isfinite(way[:, frame - first, 0])]
        segments = np.stack([way[:, :-1], way[:, 1:]], axis=2).reshape(-1, 2, 3)
        segments = segments[np.isfinite(segments).all(axis=(1, 2))]
        velocity = (segments[:, 1] - segments[:, 0]) * self.fps
        speed = np.linalg.norm(velocity, axis=1)
        if color_by == "direction":
            unit = velocity / np.maximum(speed, 1e-9)[:, None]
            colors = 255 * (0.5 + 0.5 * unit)
        else:
            colors = 255 * matplotlib.colormaps["plasma"](np.clip(speed / self.top_speed, 0, 1))[:, :3]
        return segments, np.repeat(np.rint(colors).astype(np.uint8)[:, None], 2, axis=1)

    # --- pictures ---

    def picture(self, camera: str, frame: int, longest_side: int, marks: Marks | None = None) -> np.ndarray:
        """Return a camera's picture, made smaller, with key-points drawn over it: (H, W, 3) uint8."""
        capture = self.results.capture
        assert capture is not None
        image = capture.frame(camera, frame)
        scale = min(1.0, longest_side / max(image.shape[:2]))
        small = resize(image, (round(image.shape[1] * scale), round(image.shape[0] * scale)))
        if marks is None:
            return small
        return marked(small, capture.rig.select([camera]), marks, frame)


def marks_of(file: KeyPointFile, paths: KeyPointPaths, chosen: str | None = None) -> Marks:
    """Return key-points as marks for pictures."""
    names = file.names
    links = np.array([[names.index(n) for n in link] for link in file.links], int).reshape(-1, 2)
    radius = np.array([p.radius for p in file.keypoint])
    return Marks(tuple(names), paths.positions, radius, paths.bridged, links, chosen)


def timeline(marks: Marks, frame: int) -> str:
    """Return a strip for each key-point that shows in which frames it is measured, bridged or lost, as HTML."""
    T = len(marks.positions)
    if not marks.names or not T:
        return ""
    states = marks.states
    rows = []
    for k, name in enumerate(marks.names):
        ends = [0, *(np.flatnonzero(np.diff(states[:, k])) + 1).tolist(), T]
        bars = "".join(
            f'<rect x="{a}" y="0" width="{b - a}" height="1" fill="{hex_color(_STATE_COLORS[int(states[a, k])])}"/>'
            for a, b in pairwise(ends)
        )
        weight = "bold" if name == marks.chosen else "normal"
        rows.append(
            f'<div style="display:flex;align-items:center;gap:6px;margin:2px 0">'
            f'<span style="width:84px;flex:none;overflow:hidden;white-space:nowrap;text-overflow:ellipsis;'
            f'font-weight:{weight}">{escape(name)}</span>'
            f'<svg viewBox="0 0 {T} 1" preserveAspectRatio="none" style="flex:1;height:9px">{bars}'
            f'<rect x="{frame}" y="0" width="{max(1.0, T / 150):g}" height="1" fill="#222831"/></svg></div>'
        )
    legend = " ".join(
        f'<span style="color:{hex_color(color)}">■</span>&nbsp;{word}'
        for word, color in (("measured", MEASURED), ("bridged", BRIDGED), ("lost", LOST))
    )
    inside = "".join(rows)
    return f'<div style="padding:2px 12px;font-size:12px">{inside}<div style="margin-top:4px">{legend}</div></div>'
