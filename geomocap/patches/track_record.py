"""The record of tracking: what was measured of which patch in which frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.trajectories import LAST_FRAME, Trajectories
from geomocap.patches.one_camera import DEPTH_PX
from geomocap.patches.surface_patches import PatchAlignment, Patches

_PLACED_PX = 0.1  # standard deviation of a patch where it is placed, pixels


@dataclass(frozen=True)
class _FramePatches:
    """Patches measured in one frame."""

    frame: int
    identity: np.ndarray
    positions: np.ndarray
    frames: np.ndarray
    sigma: np.ndarray
    correlation: np.ndarray
    n_views: np.ndarray
    ray: np.ndarray


class TrackRecord:
    """Collects what was measured, frame by frame, and makes trajectories of it."""

    def __init__(self, n_frames: int) -> None:
        self.n_frames = n_frames
        self._measured: list[_FramePatches] = []
        self._placed: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._ends: list[tuple[bool, np.ndarray, np.ndarray]] = []

    def measured(
        self, frame: int, identity: np.ndarray, found: PatchAlignment, rows: np.ndarray, centers: np.ndarray
    ) -> None:
        """Keep what cameras at `centers` found of patches `identity` (A,), the `rows` (A,) of an alignment."""
        alone = np.where(found.n_views[rows] == 1, found.by_camera[rows].argmax(axis=1), -1)
        self._measured.append(
            _FramePatches(
                frame,
                identity,
                found.positions[rows],
                found.frames[rows],
                found.sigma[rows],
                found.correlation[rows],
                found.n_views[rows],
                _ray(found.positions[rows], alone, centers),
            )
        )

    def at(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what has been measured in a frame: identities (A,), positions (A, 3) and normals (A, 3)."""
        here = [m for m in self._measured if m.frame == frame]
        if not here:
            return np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3))
        return (
            np.concatenate([m.identity for m in here]),
            np.concatenate([m.positions for m in here]),
            np.concatenate([m.frames[:, :, 2] for m in here]),
        )

    def placed(self, frame: int, identity: np.ndarray, patches: Patches, centers: np.ndarray) -> None:
        """Keep new patches: their templates fit themselves, to a tenth of a pixel; a single camera sees no depth."""
        self._placed.append((frame, identity, patches.frames))
        views = patches.has.sum(axis=1)
        one = np.ones(len(patches))
        alone = np.where(views == 1, patches.has.argmax(axis=1), -1)
        blind = np.where(views == 1, np.sqrt((2 * _PLACED_PX**2 + DEPTH_PX**2) / 3), _PLACED_PX)
        ray = _ray(patches.positions, alone, centers)
        self._measured.append(
            _FramePatches(frame, identity, patches.positions, patches.frames, blind * patches.size, one, views, ray)
        )

    def ended(self, identity: np.ndarray, reason: np.ndarray, forward: bool) -> None:
        """Keep why patches are followed no further."""
        self._ends.append((forward, identity, reason))

    def trajectories(self, count: int) -> Trajectories:
        """Return all `count` trajectories; what was collected is gone then."""
        T = self.n_frames
        # all but the positions in single precision: long recordings have many trajectories, each with all frames
        positions = np.full((count, T, 3), np.nan)
        rotations = np.full((count, T, 3, 3), np.nan, np.float32)
        sigma, correlation = np.full((count, T), np.nan, np.float32), np.full((count, T), np.nan, np.float32)
        n_views, ray = np.zeros((count, T), np.int16), np.zeros((count, T, 3), np.float32)
        first, placed = np.zeros((count, 3, 3)), np.zeros(count, int)
        for frame, identity, frames in self._placed:
            first[identity], placed[identity] = frames, frame
        while self._measured:
            m = self._measured.pop()
            positions[m.identity, m.frame] = m.positions
            rotations[m.identity, m.frame] = m.frames @ np.swapaxes(first[m.identity], 1, 2)
            sigma[m.identity, m.frame], correlation[m.identity, m.frame] = m.sigma, m.correlation
            n_views[m.identity, m.frame], ray[m.identity, m.frame] = m.n_views, m.ray
        end, begin = np.full(count, LAST_FRAME), np.full(count, LAST_FRAME)
        for forward, identity, reason in self._ends:
            (end if forward else begin)[identity] = reason
        normals = first[:, :, 2]
        return Trajectories(positions, rotations, sigma, correlation, n_views, ray, normals, placed, end, begin)


def _ray(positions: np.ndarray, camera: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Unit vectors (A, 3) to positions (A, 3) from cameras (A,); 0 for camera −1."""
    direction = positions - centers[camera]
    return np.where(camera[:, None] < 0, 0.0, direction / np.linalg.norm(direction, axis=1, keepdims=True))
