"""Editing key-points: what there is, what is chosen, what can be undone. Every edit returns a new session."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np

from geomocap.errors import SettingsError
from geomocap.keypoints.keypoint_following import KeyPointPaths, Measured
from geomocap.keypoints.keypoint_regions import KeyPoint, KeyPointFile, follow_regions
from geomocap.settings import check_settings


@dataclass(frozen=True)
class Session:
    """The key-points being edited.

    Attributes
    ----------
    file : KeyPointFile
        Key-points and links as they are now.
    chosen : str or None
        Name of the key-point that handles and fields belong to.
    saved : KeyPointFile
        As they were saved or loaded last.
    past, future : tuple of KeyPointFile
        What undo and redo go back to.
    last_edit : tuple of str
        Kind and name of the last edit: a slider that moves on makes one step of undo, not many.
    """

    file: KeyPointFile = field(default_factory=KeyPointFile)
    chosen: str | None = None
    saved: KeyPointFile = field(default_factory=KeyPointFile)
    past: tuple[KeyPointFile, ...] = ()
    future: tuple[KeyPointFile, ...] = ()
    last_edit: tuple[str, str] = ("", "")

    @classmethod
    def open(cls, file: KeyPointFile) -> Session:
        """Begin with the key-points of a file, the first of them chosen."""
        return cls(file, file.names[0] if file.keypoint else None, file)

    # --- what there is ---

    @property
    def point(self) -> KeyPoint | None:
        """The chosen key-point."""
        return next((p for p in self.file.keypoint if p.name == self.chosen), None)

    @property
    def is_changed(self) -> bool:
        """Whether there is something to save."""
        return self.file != self.saved

    # --- edits ---

    def choose(self, name: str | None) -> Session:
        """Choose a key-point by its name; None for none."""
        return replace(self, chosen=name if name in self.file.names else None, last_edit=("", ""))

    def place(self, center: np.ndarray, frame: int, radius: float | None = None) -> Session:
        """Add a key-point with a name of its own and the radius of the one chosen before, and choose it."""
        taken = self.file.names
        name = next(f"point {k}" for k in count(1) if f"point {k}" not in taken)
        if radius is None:
            radius = self.point.radius if self.point is not None else KeyPoint.model_fields["radius"].default
        added = KeyPoint(name=name, center=_triple(center), radius=radius, frame=frame)
        file = self.file.model_copy(update={"keypoint": (*self.file.keypoint, added)})
        return replace(self._edited(file, "place", name), chosen=name)

    def move(self, name: str, center: np.ndarray, frame: int) -> Session:
        """Put a key-point elsewhere; from now on it is followed from this frame."""
        return self._edited(self._with(name, center=_triple(center), frame=frame), "move", name)

    def resize(self, name: str, radius: float) -> Session:
        """Give a key-point another radius, metres; steps on end become one step of undo."""
        return self._edited(self._with(name, radius=radius), "resize", name, join=True)

    def rename(self, name: str, new: str) -> Session:
        """Give a key-point another name, in the links too.

        Raises
        ------
        SettingsError
            If it is empty, too long or taken.
        """
        if new == name:
            return self
        if new in self.file.names:
            raise SettingsError(f"there is a key-point {new} already; names must be unique")
        points = [p.model_dump() | ({"name": new} if p.name == name else {}) for p in self.file.keypoint]
        links = [[new if n == name else n for n in link] for link in self.file.links]
        file = check_settings(KeyPointFile, {"links": links, "keypoint": points}, "key-points")
        return replace(self._edited(file, "rename", new), chosen=new if self.chosen == name else self.chosen)

    def delete(self, name: str) -> Session:
        """Take a key-point away with its links; the one before it is chosen."""
        places = self.file.names
        points = tuple(p for p in self.file.keypoint if p.name != name)
        links = tuple(link for link in self.file.links if name not in link)
        file = self.file.model_copy(update={"keypoint": points, "links": links})
        chosen = self.chosen
        if chosen == name:
            chosen = points[max(places.index(name) - 1, 0)].name if points else None
        return replace(self._edited(file, "delete", name), chosen=chosen)

    def link(self, name: str, other: str) -> Session:
        """Join two key-points by a line, or take the line away if there is one."""
        if name == other or not {name, other} <= set(self.file.names):
            return self
        kept = tuple(link for link in self.file.links if set(link) != {name, other})
        links = (*kept, (name, other)) if len(kept) == len(self.file.links) else kept
        return self._edited(self.file.model_copy(update={"links": links}), "link", name)

    def undo(self) -> Session:
        """Go back one edit, if there is one."""
        if not self.past:
            return self
        return self._at(self.past[-1], self.past[:-1], (self.file, *self.future))

    def redo(self) -> Session:
        """Go forward again one edit, if one was undone."""
        if not self.future:
            return self
        return self._at(self.future[0], (*self.past, self.file), self.future[1:])

    def was_saved(self) -> Session:
        """Return the session with nothing to save."""
        return replace(self, saved=self.file, last_edit=("", ""))

    # --- how ---

    def _with(self, name: str, **changes: object) -> KeyPointFile:
        points = tuple(p.model_copy(update=changes) if p.name == name else p for p in self.file.keypoint)
        return self.file.model_copy(update={"keypoint": points})

    def _edited(self, file: KeyPointFile, kind: str, name: str, join: bool = False) -> Session:
        if file == self.file:
            return self
        goes_on = join and self.last_edit == (kind, name)
        past = self.past if goes_on else (*self.past, self.file)
        return replace(self, file=file, past=past, future=(), last_edit=(kind, name))

    def _at(self, file: KeyPointFile, past: tuple[KeyPointFile, ...], future: tuple[KeyPointFile, ...]) -> Session:
        chosen = self.chosen if self.chosen in file.names else None
        new = [n for n in file.names if n not in self.file.names]
        return replace(self, file=file, past=past, future=future, chosen=new[-1] if new else chosen, last_edit=("", ""))


def _triple(center: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in np.asarray(center, float).ravel())
    return x, y, z


@dataclass(frozen=True)
class Follower:
    """Paths of key-points, each worked out once and kept as long as it is of use.

    Attributes
    ----------
    measured : Measured
        The run's trajectories.
    kept : int
        Paths that are remembered at most.
    """

    measured: Measured
    kept: int = 256
    _paths: OrderedDict[tuple, KeyPointPaths] = field(default_factory=OrderedDict, repr=False, compare=False)

    def __call__(self, file: KeyPointFile) -> KeyPointPaths:
        """Follow all key-points of a file: arrays (T, K, …) in its order."""
        found = [self._path(p) for p in file.keypoint]
        if not found:
            return follow_regions(self.measured, ())
        names = ("positions", "bridged", "n_tracks", "std")
        return KeyPointPaths(*(np.concatenate([getattr(f, n) for f in found], axis=1) for n in names))

    def _path(self, point: KeyPoint) -> KeyPointPaths:
        key = (point.center, point.radius, point.frame)
        if key not in self._paths:
            self._paths[key] = follow_regions(self.measured, (point,))
            while len(self._paths) > self.kept:
                self._paths.popitem(last=False)
        self._paths.move_to_end(key)
        return self._paths[key]


def pick_surface(points: np.ndarray, spacing: float, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """Return where a ray first meets a surface given by points, or None where it misses.

    Parameters
    ----------
    points : (N, 3) float, metres
    spacing : float, metres
        Distance of neighbouring points: how far from the ray they may lie.
    origin, direction : (3,) float
    """
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    relative = points - np.asarray(origin, float)
    depth = relative @ direction
    aside = np.linalg.norm(relative - depth[:, None] * direction, axis=1)
    hit = (depth > 0) & (aside <= 1.2 * spacing)
    if not hit.any():
        return None
    first = depth[hit].min()
    near = hit & (depth <= first + 2 * spacing)
    return np.asarray(origin, float) + direction * float(depth[near].mean())


def pick_ball(centers: np.ndarray, radii: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> int | None:
    """Return the number of the ball that a ray meets first, or None; centres that are NaN are nowhere.

    Parameters
    ----------
    centers : (K, 3) float, metres
    radii : (K,) float, metres
    origin, direction : (3,) float
    """
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    relative = centers - np.asarray(origin, float)
    along = relative @ direction
    square = radii**2 - (np.einsum("ki,ki->k", relative, relative) - along**2)
    with np.errstate(invalid="ignore"):
        entry = np.where((square >= 0) & (along > 0), along - np.sqrt(np.maximum(square, 0)), np.inf)
    entry = np.where(np.isnan(entry), np.inf, entry)
    return int(entry.argmin()) if len(entry) and np.isfinite(entry.min()) else None
