"""What cameras have seen of patches: the one thing of them that changes in place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_ROOM = 1.5  # of the rows in use, when a store is made anew: so each is copied about twice in all


@dataclass
class TemplateStore:
    """What cameras have seen of R patches. It changes in place, as copies of it would cost more than following patches.

    Patches share the store of those they were selected from, and know their rows in it. `with_templates` fills it where
    the patches that it is given have no template; those who gave one up (`renewed`) are not used any more.

    Attributes
    ----------
    templates : (R, C, L, M, 3) float32
        Grey level and its slopes along s and t, for each camera and blur level; C = 1 where all cameras share one.
    usable : (R, C, M) uint8
        Samples that the template has.
    used : int
        Rows from here on are room for others.
    """

    templates: np.ndarray
    usable: np.ndarray
    used: int

    @classmethod
    def blank(cls, rows: int, cameras: int, levels: int, samples: int) -> TemplateStore:
        """Return a store without templates."""
        templates = np.zeros((rows, cameras, levels, samples, 3), np.float32)
        return cls(templates, np.zeros((rows, cameras, samples), np.uint8), rows)

    def join(
        self, rows: np.ndarray, other: TemplateStore, other_rows: np.ndarray
    ) -> tuple[TemplateStore, np.ndarray, np.ndarray]:
        """Put some rows of another store behind those of this one.

        There is room for more than was asked for: where it suffices only the new rows are copied, into this store.
        Where it doesn't, both move to a larger store, without the rows that nobody uses any more.

        Parameters
        ----------
        rows : (N,) int
            Rows of this store that are in use; the others may go.
        other : TemplateStore
        other_rows : (K,) int

        Returns
        -------
        store : TemplateStore
        rows, other_rows : (N,), (K,) int
            Where they are in it.
        """
        store, begin = self, self.used
        if begin + len(other_rows) > len(self.templates):
            begin = len(rows)
            size = int(_ROOM * (begin + len(other_rows)))
            templates, usable = (np.empty((size, *a.shape[1:]), a.dtype) for a in (self.templates, self.usable))
            store = TemplateStore(templates, usable, begin)
            store._write(0, self, rows)
            rows = np.arange(begin)
        store._write(begin, other, other_rows)
        store.used = begin + len(other_rows)
        return store, rows, np.arange(begin, store.used)

    def _write(self, begin: int, other: TemplateStore, rows: np.ndarray) -> None:
        for mine, new in ((self.templates, other.templates), (self.usable, other.usable)):
            # "raise" would copy once more
            np.take(new, rows, axis=0, out=mine[begin : begin + len(rows)], mode="clip")

    def of_one_camera(self, rows: np.ndarray, camera: np.ndarray) -> tuple[TemplateStore, np.ndarray]:
        """Return this store as one whose patches have a template for all cameras, and where (N,) those of `rows` are.

        It is the one that a camera, (N,) int, has in each of the rows (N,). Nothing is copied: it is for looking only.
        """
        R, C = self.usable.shape[:2]
        templates, usable = (a.reshape(R * C, 1, *a.shape[2:]) for a in (self.templates, self.usable))
        return TemplateStore(templates, usable, self.used * C), rows * C + camera
