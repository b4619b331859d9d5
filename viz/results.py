"""What a run folder holds, read part by part; parts that aren't there are None or empty, never an error."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from geomocap.errors import RunError
from geomocap.files.capture import Capture
from geomocap.files.frame_files import ply_count, read_points, read_voxels
from geomocap.files.images import read_image
from geomocap.files.run import Run
from geomocap.model.frame_geometry import BodyPoints, Voxels

KINDS = ("bodies", "voxels", "cloud")


@dataclass(frozen=True)
class Ellipsoids:
    """`ellipsoids.npz`: centers (T,K,3), radii (T,K,3), rotations (T,K,3,3), counts, errors (T,K), body (K,).

    The centre of an ellipsoid is NaN in the frames in which no points belong to it.
    """

    centers: np.ndarray
    radii: np.ndarray
    rotations: np.ndarray
    counts: np.ndarray | None
    errors: np.ndarray | None
    body: np.ndarray

    @property
    def n_bodies(self) -> int:
        """Number of bodies that they belong to."""
        return int(self.body.max(initial=-1)) + 1


@dataclass(frozen=True)
class Skeleton:
    """`skeleton.npz`: joints (T,J,3) between bodies (J,2), rotations (T,B,3,3) and positions (T,B,3) of bodies."""

    joint_positions: np.ndarray
    joint_bodies: np.ndarray
    joint_names: tuple[str, ...]
    body_rotations: np.ndarray
    body_positions: np.ndarray
    fps: float

    @property
    def n_bodies(self) -> int:
        """Number of bodies."""
        return self.body_positions.shape[1]

    @cached_property
    def parent_joint(self) -> np.ndarray:
        """Joint by which each body hangs on its parent, (B,) int; -1 for roots."""
        joint = np.full(self.n_bodies, -1)
        joint[self.joint_bodies[:, 1]] = np.arange(len(self.joint_bodies))
        return joint

    @cached_property
    def bones(self) -> list[tuple[int, int, int]]:
        """Pairs of joints on one body: (body, joint to its parent or -1 for the body's own place, joint to a child)."""
        return [
            (int(parent), int(self.parent_joint[parent]), j) for j, (parent, _) in enumerate(self.joint_bodies.tolist())
        ]

    @cached_property
    def leaves(self) -> list[int]:
        """Bodies without children."""
        return sorted(set(range(self.n_bodies)) - set(self.joint_bodies[:, 0].tolist()))

    def place(self, frame: int, body: int, joint: int) -> np.ndarray:
        """Return a joint's position in a frame, or the body's where `joint` is -1: (3,) metres."""
        return self.body_positions[frame, body] if joint < 0 else self.joint_positions[frame, joint]

    def joint_rotations(self) -> np.ndarray:
        """Return each joint's rotation since frame 0 as rotation vectors (T, J, 3), degrees, parent's axes.

        Of the vectors that mean the same rotation, that nearest to the frame before is taken: no jumps at 180°.
        """
        from scipy.spatial.transform import Rotation

        parent = self.body_rotations[:, self.joint_bodies[:, 0]]
        child = self.body_rotations[:, self.joint_bodies[:, 1]]
        relative = np.einsum("tjba,tjbc->tjac", parent, child)
        first = relative[:1]
        turn = np.einsum("tjab,tjcb->tjac", relative, np.broadcast_to(first, relative.shape))
        flat = turn.reshape(-1, 3, 3)
        whole = np.isfinite(flat).all(axis=(1, 2))
        vectors = np.full((len(flat), 3), np.nan)
        if whole.any():
            vectors[whole] = Rotation.from_matrix(flat[whole]).as_rotvec(degrees=True)
        return _continuous(vectors.reshape(*relative.shape[:2], 3))


@dataclass(frozen=True)
class Results:
    """The files of a run, and the capture that it came from if that is at hand."""

    run: Run
    capture: Capture | None = None

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
        for arrays in (self.skeleton, self.ellipsoids):
            if isinstance(arrays, Skeleton):
                return list(range(len(arrays.joint_positions)))
            if isinstance(arrays, Ellipsoids):
                return list(range(len(arrays.centers)))
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
        lengths = [len(s.joint_positions) for s in (self.skeleton,) if s is not None]
        lengths += [len(e.centers) for e in (self.ellipsoids,) if e is not None]
        if lengths and lengths[0] > len(self.frames):
            return min(frame, lengths[0] - 1)
        return self.frames.index(frame) if frame in self.frames else 0

    @cached_property
    def counts(self) -> dict[str, np.ndarray]:
        """Points of each frame by kind: {kind: (T,) int}."""
        return {k: np.array([ply_count(self.run.frame_file(k, f)) for f in self.run.frames(k)]) for k in self.kinds}

    # --- arrays over time ---

    @cached_property
    def ellipsoids(self) -> Ellipsoids | None:
        """`ellipsoids.npz`, if it is there."""
        data = self._npz("ellipsoids.npz", ("centers", "radii", "rotations"))
        if data is None:
            return None
        centers, counts = data["centers"], data.get("counts")
        if counts is not None:
            centers = np.where(counts[..., None] > 0, centers, np.nan)
        body = data.get("body", np.full(centers.shape[1], -1)).astype(int)
        return Ellipsoids(centers, data["radii"], data["rotations"], counts, data.get("errors"), body)

    @cached_property
    def skeleton(self) -> Skeleton | None:
        """`skeleton.npz`, if it is there and holds a joint."""
        data = self._npz("skeleton.npz", ("joint_positions", "joint_bodies", "body_rotations", "body_positions"))
        if data is None or data["joint_positions"].shape[1] == 0:
            return None
        count = data["joint_positions"].shape[1]
        names = tuple(str(n) for n in data.get("joint_names", [f"joint {j}" for j in range(count)]))
        return Skeleton(
            data["joint_positions"],
            data["joint_bodies"].astype(int),
            names,
            data["body_rotations"],
            data["body_positions"],
            float(data.get("fps", 0.0)),
        )

    @cached_property
    def diagnostics(self) -> dict[str, np.ndarray]:
        """Arrays of `diagnostics.npz`, empty if it isn't there."""
        return self._npz("diagnostics.npz", ()) or {}

    @cached_property
    def remarks(self) -> list[str]:
        """Warnings in words that the stages left in `diagnostics.json` (key `warnings`)."""
        file = self.run.path / "diagnostics.json"
        try:
            return [str(w) for w in json.loads(file.read_text(encoding="utf-8")).get("warnings", [])]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, AttributeError) as error:
            raise RunError(f"{file}: damaged ({error}); delete it and run again") from None

    def _npz(self, name: str, needed: tuple[str, ...]) -> dict[str, np.ndarray] | None:
        if not (self.run.path / name).is_file():
            return None
        data = self.run.read_npz(name)
        missing = [k for k in needed if k not in data]
        if missing:
            raise RunError(f"{self.run.path / name}: has no array {', '.join(missing)}; delete it and run again")
        return data

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
        return read_image(file, gray=True) if file.is_file() else None


def _finite(points: np.ndarray) -> np.ndarray:
    return points[np.isfinite(points).all(axis=1)]


def _continuous(vectors: np.ndarray) -> np.ndarray:
    """Add whole turns to rotation vectors (T, J, 3), degrees, so that they stay near those of the frame before."""
    vectors = vectors.copy()
    for t in range(1, len(vectors)):
        size = np.linalg.norm(vectors[t], axis=1, keepdims=True)
        axis = vectors[t] / np.maximum(size, 1e-12)
        turned = np.stack([vectors[t] + 360 * k * axis for k in (0, -1, 1)])
        distance = np.nan_to_num(np.linalg.norm(turned - vectors[t - 1], axis=2), nan=0.0)
        vectors[t] = np.take_along_axis(turned, distance.argmin(axis=0)[None, :, None], axis=0)[0]
    return vectors
