"""What cameras have seen of patches: the one thing of them that changes in place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class TemplateStore:
    """What cameras have seen of R patches. It changes in place, as copies of it would cost more than following patches.

    Patches share the store of those they were selected from, and know their rows in it. `with_templates` fills it where
    the patches that it is given have no template; those who gave one up (`renewed`) are not used any more.

    Attributes
    ----------
    templates : (R, C, L, M, 3) float32
        Grey level and its slopes along s and t, for each camera and blur level.
    usable : (R, C, M) uint8
        Samples that the template has.
    """

    templates: np.ndarray
    usable: np.ndarray

    @classmethod
    def blank(cls, rows: int, cameras: int, levels: int, samples: int) -> TemplateStore:
        """Return a store without templates."""
        templates = np.zeros((rows, cameras, levels, samples, 3), np.float32)
        return cls(templates, np.zeros((rows, cameras, samples), np.uint8))

    def join(self, rows: np.ndarray, other: TemplateStore, other_rows: np.ndarray) -> TemplateStore:
        """Return some rows of this store followed by some of another, copied."""
        parts, count = [], len(rows)
        for mine, new in ((self.templates, other.templates), (self.usable, other.usable)):
            both = np.empty((count + len(other_rows), *mine.shape[1:]), mine.dtype)
            np.take(mine, rows, axis=0, out=both[:count], mode="clip")  # "raise" would copy once more
            np.take(new, other_rows, axis=0, out=both[count:], mode="clip")
            parts.append(both)
        return TemplateStore(*parts)

    def of_one_camera(self, rows: np.ndarray, camera: np.ndarray) -> TemplateStore:
        """Return rows (N,) copied, in which all cameras have the template of one, (N,) int."""
        count = self.templates.shape[1]
        arrays = (self.templates, self.usable)
        return TemplateStore(
            *(np.ascontiguousarray(np.repeat(a[rows, camera][:, None], count, axis=1)) for a in arrays)
        )
