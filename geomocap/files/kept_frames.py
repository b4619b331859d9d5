"""Decoded frames of a short recording, kept so that a stage doesn't decode again what another one has decoded."""

from __future__ import annotations

import threading

import numpy as np

KEPT = 64e6  # bytes of a camera's frames; those of a longer recording, or larger ones, are not kept


class KeptFrames:
    """Room for all frames of a camera, if they are small. May be shared by threads.

    Parameters
    ----------
    count : int
        Frames of the camera.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._lock = threading.Lock()
        self._room: np.ndarray | None = None
        self._known: set[int] = set()

    def get(self, frame: int) -> np.ndarray | None:
        """Return a copy of a frame that is kept, or None."""
        return self._room[frame].copy() if frame in self._known and self._room is not None else None

    def keep(self, frame: int, image: np.ndarray) -> None:
        """Keep a frame, (H, W, 3) uint8, unless all of them would take too much memory."""
        if image.nbytes * self._count > KEPT:
            return
        with self._lock:
            if self._room is None:  # one array, of which only what is filled takes memory
                self._room = np.empty((self._count, *image.shape), image.dtype)
        self._room[frame] = image
        self._known.add(frame)
