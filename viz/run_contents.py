"""What a run folder holds, read part by part; parts that aren't there are None or empty, never an error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from geomocap.export.names import Names
from geomocap.files.camera_file import CameraDoubts, read_camera_doubts
from geomocap.files.capture import Capture
from geomocap.files.results import (
    ELLIPSOIDS,
    KEYPOINTS,
    SKELETON,
    TRACKS,
    ply_count,
    read_diagnostics,
    read_ellipsoids,
    read_keypoint_paths,
    read_points,
    read_silhouette,
    read_skeleton,
    read_tracks,
    read_voxels,
    read_warnings,
)
from geomocap.files.run import Run
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.model.frame_geometry import BodyPoints, Voxels
from geomocap.model.keypoint_paths import KeyPoints
from geomocap.model.skeleton import Skeleton, body_names
from geomocap.model.trajectories import Tracks
from viz.kept_values import KeptValues

KINDS = ("bodies", "voxels", "cloud")


@dataclass(frozen=True)
class Results:
    """The files of a run, and the capture that it came from if that is at hand.

    Its bodies and joints are called as `names` says; by default as the files say, by number.
    """

    run: Run
    capture: Capture | None = None
    names: Names | None = None

    @cached_property
    def kept(self) -> KeptValues:
        """Meshes of the last frames that were drawn."""
        return KeptValues()

    @cached_property
    def record(self) -> dict[str, Any]:
        """`run.toml`; empty if there is none."""
        return self.run.read_record() if (self.run.path / "run.toml").is_file() else {}

    @cached_property
    def frames(self) -> list[int]:
        """Frame numbers of the richest kind of geometry, or those of the capture if there is none yet."""
        for kind in KINDS:
            if found := self.run.frames(kind):
                return found
        for values in (self.skeleton, self.ellipsoids):
            if values is not None:
                return list(range(values.frame_count))
        return sorted({f for c in self.silhouette_cameras for f in self.silhouette_frames(c)})

    @cached_property
    def kinds(self) -> list[str]:
        """Kinds of geometry that are there."""
        return [k for k in KINDS if self.run.frames(k)]

    @property
    def fps(self) -> float | None:
        """Frames per second, if known."""
        if self.capture is not None:
            return self.capture.fps
        return self.skeleton.fps if self.skeleton is not None else None

    @property
    def up(self) -> str:
        """World axis that points up; z unless the capture or the run's record says otherwise."""
        if self.capture is not None:
            return self.capture.info.up
        for table in (self.record, *(v for v in self.record.values() if isinstance(v, dict))):
            if table.get("up") in ("x", "y", "z"):
                return str(table["up"])
        return "z"

    # --- geometry ---

    def has(self, kind: str, frame: int) -> bool:
        """Whether a frame has this kind of geometry."""
        return self.run.frame_file(kind, frame).is_file()

    def voxels(self, frame: int) -> Voxels:
        """Read the voxels of a frame."""
        return read_voxels(self.run.frame_file("voxels", frame))

    def cloud(self, frame: int) -> BodyPoints:
        """Read the cloud of a frame."""
        return read_points(self.run.frame_file("cloud", frame)).finite

    def bodies(self, frame: int) -> BodyPoints:
        """Read the bodies of a frame; points without a `body` attribute count as unassigned."""
        return read_points(self.run.frame_file("bodies", frame)).finite

    def any_points(self, frame: int) -> np.ndarray:
        """Points of a frame from whatever is there: (N, 3) float, metres; empty if nothing is."""
        for kind in self.kinds:
            if self.has(kind, frame):
                return self.voxels(frame).points if kind == "voxels" else getattr(self, kind)(frame).positions
        place = self.place(frame)
        if self.ellipsoids is not None:
            return _finite(self.ellipsoids.centers[place])
        if self.skeleton is not None:
            return _finite(np.concatenate([self.skeleton.joint_positions[place], self.skeleton.body_positions[place]]))
        return np.zeros((0, 3))

    def place(self, frame: int) -> int:
        """Place of a frame number in the arrays over time.

        Arrays that hold more frames than there are files (some were deleted) count from frame 0.
        """
        lengths = [values.frame_count for values in (self.skeleton, self.ellipsoids) if values is not None]
        if lengths and lengths[0] > len(self.frames):
            return min(frame, lengths[0] - 1)
        return self.frames.index(frame) if frame in self.frames else 0

    @cached_property
    def counts(self) -> dict[str, np.ndarray]:
        """Points of each frame by kind: {kind: (T,) int}."""
        return {k: np.array([ply_count(self.run.frame_file(k, f)) for f in self.run.frames(k)]) for k in self.kinds}

    # --- values over time ---

    @cached_property
    def ellipsoids(self) -> Ellipsoids | None:
        """The ellipsoids, if they are there; their centres are NaN where no points belong to them."""
        if not self.run.has(ELLIPSOIDS):
            return None
        found = read_ellipsoids(self.run)
        return replace(found, centers=found.seen_centers)

    @cached_property
    def skeleton(self) -> Skeleton | None:
        """The skeleton, if it is there; that of a single rigid body has no joints."""
        found = read_skeleton(self.run) if self.run.has(SKELETON) else None
        if found is None or self.names is None:
            return found
        bodies = self.names.body_names(found.body_count, found.body_names)
        joints = self.names.joint_names(found.joint_bodies, bodies, found.joint_names)
        return replace(found, body_names=np.array(bodies), joint_names=np.array(joints))

    def body_name(self, body: int) -> str:
        """Return what a body is called, also where no skeleton says it."""
        s = self.skeleton
        return str(s.body_names[body]) if s is not None and body < s.body_count else str(body_names(body + 1)[body])

    @cached_property
    def tracks(self) -> Tracks | None:
        """The trajectories, if they are there."""
        return read_tracks(self.run) if self.run.has(TRACKS) else None

    @cached_property
    def keypoints(self) -> KeyPoints | None:
        """The key-points, if they are there."""
        return read_keypoint_paths(self.run) if self.run.has(KEYPOINTS) else None

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """How bodies and skeleton came about, as far as it is known."""
        return read_diagnostics(self.run)

    @cached_property
    def camera_doubts(self) -> CameraDoubts:
        """What was found to be doubtful about the cameras."""
        return read_camera_doubts(self.run)

    @cached_property
    def remarks(self) -> list[str]:
        """Warnings in words that the stages left, those about the cameras first."""
        return [*self.camera_doubts.warnings, *read_warnings(self.run)]

    # --- silhouettes ---

    @cached_property
    def silhouette_cameras(self) -> tuple[str, ...]:
        """Cameras that have silhouettes, in the capture's order."""
        found = sorted(p.name for p in (self.run.path / "silhouettes").glob("*") if p.is_dir())
        order = self.capture.cameras if self.capture is not None else ()
        return tuple(c for c in order if c in found) or tuple(found)

    def silhouette_frames(self, camera: str) -> list[int]:
        """Frames of which a camera has silhouettes."""
        return sorted(int(p.stem) for p in (self.run.path / "silhouettes" / camera).glob("[0-9]*.png"))

    def silhouette(self, camera: str, frame: int) -> np.ndarray | None:
        """Read a silhouette, (H, W) uint8, 0 or 255; None if there is none."""
        file = self.run.silhouette_file(camera, frame)
        return read_silhouette(self.run, camera, frame) if file.is_file() else None


def _finite(points: np.ndarray) -> np.ndarray:
    return points[np.isfinite(points).all(axis=1)]
