"""What the viewer shows: a run, a capture, scans, a calibration or a motion file, all as one kind of value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from geomocap.angles.angle_set import AngleSet
from geomocap.errors import GeometryError
from geomocap.evaluation.other_system import read_motion_file
from geomocap.export.bvh import read_bvh
from geomocap.export.conventions import Axis
from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.markers import Markers
from geomocap.export.motion_tree import MotionTree
from geomocap.export.run_export import surface_of_run
from geomocap.export.skinned_mesh import SkinnedMesh
from geomocap.files.capture import Capture
from geomocap.files.rigs import read_rig
from geomocap.files.run import Run
from geomocap.files.scan_geometry import SCAN_ENDINGS
from geomocap.files.scan_settings import ScanSettings
from geomocap.files.scans import open_scans
from geomocap.inspection.describe import InspectionError
from geomocap.inspection.motion_files import ENDINGS
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.model.rig import Rig
from viz.drawing import resize
from viz.keypoint_scene import SceneSurface
from viz.run_contents import Results
from viz.scene import stage as stage_of_run
from viz.shown_angles import angle_words, angles_of
from viz.shown_names import joint_names
from viz.turntable import motion_of
from viz.view_shapes import MovingSurface
from viz.viewpoints import ViewStage, stage_of, up_vector
from viz.volumes import spacing

GREY = (150, 156, 165)
"""Colour of points that have none, RGB 0–255."""


@dataclass(frozen=True)
class FollowedPoints:
    """Points that bodies were found from: places (N, T, 3) metres, and the body of each (N,), -1: none."""

    places: np.ndarray
    bodies: np.ndarray


@dataclass(frozen=True)
class Content:
    """Something that moves, or stands, and can be looked at.

    Attributes
    ----------
    title : str
    n_frames : int
    fps : float
    up : "x", "y" or "z"
    points : callable
        Points of a frame, None if there are none.
    motion : MotionTree, optional
        Bodies and joints.
    mesh : SkinnedMesh, optional
        The surface that `motion` moves.
    surface : MovingSurface, optional
        One that moves by rules of its own.
    free : set of int
        Nodes of the motion that hang on nothing: no bone leads to them.
    joint_names : tuple of str
        Of the motion's nodes: what the joint at the origin of each is called.
    markers : Markers, optional
    ellipsoids : Ellipsoids, optional
    followed : FollowedPoints, optional
    rig : Rig, optional
    picture : callable, optional
        A camera's picture of a frame, made smaller to a width at most: (H, W, 3) uint8.
    results : Results, optional
        The run.
    """

    title: str
    n_frames: int
    fps: float
    up: Axis
    points: Callable[[int], SceneSurface | None] = field(default=lambda _: None)
    motion: MotionTree | None = None
    mesh: SkinnedMesh | None = None
    surface: MovingSurface | None = None
    free: frozenset[int] = frozenset()
    joint_names: tuple[str, ...] = ()
    markers: Markers | None = None
    ellipsoids: Ellipsoids | None = None
    followed: FollowedPoints | None = None
    rig: Rig | None = None
    picture: Callable[[str, int, int], np.ndarray] | None = None
    results: Results | None = None

    @cached_property
    def stage(self) -> ViewStage:
        """Where the motion takes place.

        Raises
        ------
        GeometryError
            If there is nothing to look at.
        """
        if self.results is not None:
            return stage_of_run(self.results)
        places = sorted({round(p) for p in np.linspace(0, self.n_frames - 1, min(10, self.n_frames))})
        return stage_of([self._any(p) for p in places], places, self.n_frames, up_vector(self.up))

    def _any(self, frame: int) -> np.ndarray:
        """Points (N, 3) of a frame from whatever is there; if nothing is, cameras and what lies before them."""
        surface = self.points(frame)
        found = [] if surface is None else [surface.points]
        if self.surface is not None:
            found.append(self.surface.at(frame))
        if self.motion is not None:
            found.append(self.bone_ends(frame).reshape(-1, 3))
        if self.markers is not None:
            found.append(self.markers.positions[min(frame, len(self.markers.positions) - 1)])
        if not found and self.rig is not None:
            reach = float(np.ptp(self.rig.centers, axis=0).max()) or 1.0  # one camera, or all in one place
            found += [self.rig.centers, self.rig.centers + 0.5 * reach * self.rig.cam_from_world[:, 2, :3]]
        points = np.concatenate(found) if found else np.zeros((0, 3))
        return points[np.isfinite(points).all(axis=1)]

    @cached_property
    def posture(self) -> tuple[np.ndarray, np.ndarray]:
        """World rotations (T, N, 3, 3) and origins (T, N, 3), metres, of the motion's nodes."""
        assert self.motion is not None
        return self.motion.forward_kinematics()

    @cached_property
    def turns_deg(self) -> np.ndarray:
        """How far each node has turned against its parent since the first frame, (T, N) degrees."""
        assert self.motion is not None
        R = self.motion.rotations
        trace = np.einsum("nij,tnij->tn", R[0], R)
        return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))

    @cached_property
    def angles(self) -> AngleSet | None:
        """Joint angles as in the run's motion files."""
        found = None if self.results is None else angles_of(self.results)
        return None if found is None else found[0]

    def told_angles(self, node: int, frame: int) -> list[str]:
        """Return the angles between a node's body and its parent's in a frame, in words."""
        motion, angles = self.motion, self.angles
        assert motion is not None
        if angles is None or motion.parents[node] < 0 or frame >= len(angles.values):
            return []
        told = []
        for k in angles.of_joint(int(motion.bodies[motion.parents[node]]), int(motion.bodies[node])):
            value, band = angles.values[frame, k], 2 * angles.std[frame, k]
            if np.isfinite(value):
                sure = f" ± {band:.1f}" if np.isfinite(band) else ""
                told.append(f"{angle_words(angles.names[k])} {value:.1f}°{sure}")
        return told

    @cached_property
    def confidence(self) -> np.ndarray:
        """Of each of the motion's bodies by node, (N,); NaN where it isn't known."""
        assert self.motion is not None
        found = np.full(self.motion.n_nodes, np.nan)
        sure = None if self.results is None else self.results.diagnostics.body_confidence
        if sure is not None:
            known = (self.motion.bodies >= 0) & (self.motion.bodies < len(sure))
            found[known] = sure[self.motion.bodies[known]]
        return found

    @cached_property
    def bones(self) -> list[tuple[int, int]]:
        """Bones as pairs of nodes: the one that carries it, and the child at its end or -1 for its own tip."""
        motion = self.motion
        assert motion is not None
        inner = [(int(motion.parents[n]), n) for n in range(1, motion.n_nodes) if n not in self.free]
        return inner + [(n, -1) for n in np.flatnonzero(np.isfinite(motion.tips).all(axis=1)).tolist()]

    def bone_ends(self, frame: int) -> np.ndarray:
        """Return the ends of all bones in a frame, (B, 2, 3) metres, world."""
        assert self.motion is not None
        R, p = (values[min(frame, len(values) - 1)] for values in self.posture)
        ends = [p[child] if child >= 0 else p[n] + R[n] @ self.motion.tips[n] for n, child in self.bones]
        return np.array([(p[n], end) for (n, _), end in zip(self.bones, ends, strict=True)]).reshape(-1, 2, 3)


def open_content(path: Path, capture: Capture | None = None) -> Content:
    """Open whatever is at a path.

    Parameters
    ----------
    path : Path
        Folder of a run, capture, calibration or scans; motion file or scan.
    capture : Capture, optional
        What a run was made from, for its cameras and pictures.

    Raises
    ------
    InspectionError
        If there is nothing at the path, or nothing known.
    GeomocapError
        If it can't be read.
    """
    if not path.exists():
        raise InspectionError(f"{path}: no such file or folder")
    if path.is_dir():
        if (path / "run.toml").is_file() or (path / "skeleton.npz").is_file():
            return of_run(Results(Run(path), capture))
        if (path / "capture.toml").is_file():
            return of_capture(Capture.open(path))
        for folder in (path, path / "sparse"):
            if any((folder / f"cameras{ending}").is_file() for ending in (".txt", ".bin")):
                return of_rig(path, read_rig(folder))
        if not any(file.suffix.lower() in SCAN_ENDINGS for file in path.iterdir()):
            below = [
                p.name
                for p in sorted(path.iterdir())
                if any((p / name).is_file() for name in ("run.toml", "capture.toml"))
            ]
            hint = f"; look into {' or '.join(below)}" if below else ""
            raise InspectionError(f"{path}: neither a run, a capture, a calibration nor scans{hint}")
    elif path.suffix.lower() in ENDINGS:
        if path.suffix.lower() == ".glb":
            raise InspectionError(f"{path}: read it with data_tools.gltf_reader and give it to of_animation")
        if path.suffix.lower() == ".bvh":
            motion = read_bvh(path)
            motion = replace(motion, bodies=np.arange(motion.n_nodes))  # each its colour
            return Content(path.name, motion.n_frames, motion.fps, motion.up, motion=motion, joint_names=motion.names)
        markers = read_motion_file(path)
        return Content(path.name, len(markers.positions), markers.fps, markers.up, markers=markers)
    elif path.suffix.lower() not in SCAN_ENDINGS:
        known = ", ".join(sorted({*ENDINGS, *SCAN_ENDINGS}))
        raise InspectionError(f"{path}: no kind of file that is shown; these are: {known}")
    scans = open_scans(path, ScanSettings())

    def points(frame: int) -> SceneSurface | None:
        found = scans.points(frame)
        return _plain(found[np.isfinite(found).all(axis=1)])

    return Content(path.resolve().name, len(scans), 25.0, "z", points)


def of_rig(path: Path, rig: Rig) -> Content:
    """Return a calibration: cameras without pictures."""
    return Content(path.resolve().name, 1, 1.0, "z", rig=rig)


def of_run(results: Results) -> Content:
    """Return a run with all that it holds so far."""
    skeleton, markers, motion, mesh = results.skeleton, None, None, None
    called: tuple[str, ...] = ()
    if skeleton is not None:
        motion = motion_of(results, skeleton)
        names = joint_names(results, skeleton)
        called = tuple(names[j] if j >= 0 else "" for j in motion.joints.tolist())
        try:
            mesh = surface_of_run(results.run, motion, ExportSettings(surface="skin"))
        except (MotionError, GeometryError):
            mesh = None  # bones and points are shown without
    up: Axis = {"x": "x", "y": "y"}.get(results.up, "z")  # type: ignore[assignment]
    if results.keypoints is not None:
        found = results.keypoints
        markers = Markers(found.names, found.paths.positions, results.fps or 25.0, up)
    count = len(results.frames) if motion is None else motion.n_frames
    if not count:
        raise InspectionError(f"{results.run.path}: the run holds nothing yet that could be looked at")

    def points(place: int) -> SceneSurface | None:
        frame = results.frames[min(place, len(results.frames) - 1)]
        if results.has("voxels", frame):
            v = results.voxels(frame)
            return SceneSurface(v.points, v.colors, v.voxel_size)
        if results.has("cloud", frame):
            c = results.cloud(frame)
            return SceneSurface(c.positions, c.shown_colors, spacing(c.positions))
        return None

    rig, picture = _cameras(results.capture, results.frames)
    title, fps = results.run.path.resolve().name, results.fps or 25.0
    shells = results.ellipsoids if results.ellipsoids is not None and results.ellipsoids.frame_count == count else None
    return Content(
        title, count, fps, up, points, motion, mesh, joint_names=called, markers=markers, ellipsoids=shells,
        followed=_followed(results, count), rig=rig, picture=picture, results=results,
    )  # fmt: skip


def _followed(results: Results, count: int) -> FollowedPoints | None:
    """Return the points that were followed through all frames; None if there are none."""
    places, bodies = results.diagnostics.sample_positions, results.diagnostics.sample_body
    if places is None or places.ndim != 3 or places.shape[1] != count or not len(places):
        return None
    known = bodies is not None and len(bodies) == len(places)
    return FollowedPoints(places, bodies if bodies is not None and known else np.full(len(places), -1))


def of_capture(capture: Capture) -> Content:
    """Return a capture: its cameras with their pictures."""
    if not capture.is_calibrated:
        raise InspectionError(f"{capture.path}: not calibrated yet, so nothing says where its cameras are")
    rig, picture = _cameras(capture, list(range(capture.n_frames)))
    up: Axis = {"x": "x", "y": "y"}.get(capture.info.up, "z")  # type: ignore[assignment]
    return Content(capture.info.name, capture.n_frames, capture.fps, up, rig=rig, picture=picture)


def _cameras(
    capture: Capture | None, frames: list[int]
) -> tuple[Rig | None, Callable[[str, int, int], np.ndarray] | None]:
    if capture is None or not capture.is_calibrated:
        return None, None

    def picture(camera: str, place: int, width: int) -> np.ndarray:
        image = capture.frame(camera, frames[min(place, len(frames) - 1)])
        scale = min(1.0, width / image.shape[1])
        return resize(image, (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))))

    return capture.rig, picture


def _plain(points: np.ndarray) -> SceneSurface:
    return SceneSurface(points, np.tile(np.array(GREY, np.uint8), (len(points), 1)), spacing(points))
