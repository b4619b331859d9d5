"""Markers between their frames."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline


class MarkerTrack:
    """Positions of markers at any time, between frames by cubic splines that never bridge a gap."""

    def __init__(self, positions: np.ndarray, fps: float) -> None:
        self.fps, self.n_frames, self.n_markers = fps, len(positions), positions.shape[1]
        self._pieces: list[list[tuple[float, float, CubicSpline | np.ndarray]]] = []
        for k in range(self.n_markers):
            present = np.isfinite(positions[:, k]).all(axis=1)
            edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(int)))
            pieces: list[tuple[float, float, CubicSpline | np.ndarray]] = []
            for start, stop in edges.reshape(-1, 2).tolist():
                t = np.arange(start, stop) / fps
                points = positions[start:stop, k]
                curve = CubicSpline(t, points) if len(t) > 1 else points[0]
                pieces.append((t[0], t[-1], curve))
            self._pieces.append(pieces)

    @property
    def duration(self) -> float:
        """Time of the last frame, seconds."""
        return (self.n_frames - 1) / self.fps

    def at(self, times: np.ndarray) -> np.ndarray:
        """Positions (T, K, 3) at times (T,) seconds; NaN in gaps and outside the recording."""
        result = np.full((len(times), self.n_markers, 3), np.nan)
        slack = 1e-6
        for k, pieces in enumerate(self._pieces):
            for first, last, curve in pieces:
                inside = (times >= first - slack) & (times <= last + slack)
                result[inside, k] = curve(times[inside]) if isinstance(curve, CubicSpline) else curve
        return result
