"""What cameras have seen of patches: the one thing of them that changes in place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_ROOM = 1.5  # of the templates in use, when a store is made anew: so each is copied about twice in all


@dataclass
class TemplateStore:
    """Templates of patches, each as one camera saw one patch: most cameras see nothing of a patch.

    It changes in place, as copies of it would cost more than following patches. Patches share the store of those they
    were selected from, and know where theirs are in it.

    Attributes
    ----------
    templates : (S, L, M, 3) float32
        Grey level and its slopes along s and t, for each blur level.
    usable : (S, M) uint8
        Samples that the template has.
    used : int
        From here on is room for others.
    """

    templates: np.ndarray
    usable: np.ndarray
    used: int

    @classmethod
    def empty(cls, levels: int, samples: int) -> TemplateStore:
        """Return a store without templates."""
        return cls(np.empty((0, levels, samples, 3), np.float32), np.empty((0, samples), np.uint8), 0)

    def with_room(self, slots: np.ndarray, count: int) -> tuple[TemplateStore, np.ndarray]:
        """Return a store that has room for `count` more templates, and where the others are in it.

        It is this one as long as its room suffices; else a larger one, without the templates that nobody uses any more.

        Parameters
        ----------
        slots : (N, C) int
            Templates of this store that are in use, −1: none.
        count : int
        """
        if self.used + count <= len(self.templates):
            return self, slots
        kept = slots[slots >= 0]
        size = int(_ROOM * (len(kept) + count))
        templates, usable = (np.empty((size, *a.shape[1:]), a.dtype) for a in (self.templates, self.usable))
        larger = TemplateStore(templates, usable, 0)
        moved = np.full_like(slots, -1)
        moved[slots >= 0] = larger._append(self, kept)
        return larger, moved

    def join(
        self, slots: np.ndarray, other: TemplateStore, other_slots: np.ndarray
    ) -> tuple[TemplateStore, np.ndarray, np.ndarray]:
        """Put templates of another store behind those of this one, or of a larger one.

        Parameters
        ----------
        slots : (N, C) int
            Templates of this store that are in use, −1: none; the others may go.
        other : TemplateStore
        other_slots : (K, C) int

        Returns
        -------
        store : TemplateStore
        slots, other_slots : (N, C), (K, C) int
            Where they are in it.
        """
        new = other_slots[other_slots >= 0]
        store, slots = self.with_room(slots, len(new))
        moved = np.full_like(other_slots, -1)
        moved[other_slots >= 0] = store._append(other, new)
        return store, slots, moved

    def _append(self, other: TemplateStore, slots: np.ndarray) -> np.ndarray:
        """Copy templates of another store, (n,), behind those that are here; where they are then."""
        begin, self.used = self.used, self.used + len(slots)
        for mine, new in ((self.templates, other.templates), (self.usable, other.usable)):
            if len(slots):  # "raise" would copy once more
                np.take(new, slots, axis=0, out=mine[begin : self.used], mode="clip")
        return np.arange(begin, self.used)
