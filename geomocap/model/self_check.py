"""How well a result agrees with what it was made from; known without any truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Verdict = Literal["trust it", "check it", "don't use it"]

# Model against silhouettes, mean, the model's shape fitted to them: 0.92 to 0.96 of right results, 0.87 of a stag whose
# legs were followed badly, 0.85 of a person before four real cameras; but 0.82 to 0.94 where limbs were merged, too.
# Not fitted: 0.65 of silhouettes full of holes
GOOD, POOR = 0.8, 0.6
# Residual of points, fraction of the diagonal: 0.0009 to 0.005 of 24 captures with core indices from 0.44 to 0.99, and
# 0.014 of one whose limbs moved too far from frame to frame to be followed (0.30)
LOOSE = 0.01
CONTRADICTS = 0.15  # by which a camera's left-out overlap is below the median camera's: it contradicts the others


@dataclass(frozen=True)
class SelfCheck:
    """Agreement of a result with the silhouettes and paths that it was made from.

    Attributes
    ----------
    cameras : tuple of C str
    frames : (F,) int
        The frames looked at.
    model : (C, F) float
        Intersection over union of the skinned model, posed and drawn, and the silhouette; NaN where a camera sees
        nothing of the subject.
    left_out : (C, F) float
        The same of the visual hull of all other cameras; NaN where it can't be made.
    residual : float
        Root mean square distance of surface points from where their bodies carry them, median over the points,
        as a fraction of the subject's diagonal; NaN if there are none.
    """

    cameras: tuple[str, ...]
    frames: np.ndarray
    model: np.ndarray
    left_out: np.ndarray
    residual: float

    @property
    def figures(self) -> dict[str, float]:
        """Figures by name: overlaps from 0 to 1, the residual in per cent of the diagonal."""
        figures = {
            "check.model_iou_mean": _mean(self.model),
            "check.model_iou_worst_camera": _least(self.model),
            "check.left_out_iou_mean": _mean(self.left_out),
            "check.left_out_iou_worst_camera": _least(self.left_out),
            "check.residual_%diagonal": 100.0 * self.residual,
        }
        return {name: value for name, value in figures.items() if np.isfinite(value)}

    @property
    def contradicting(self) -> tuple[str, ...]:
        """Cameras whose silhouettes the others explain much worse than most."""
        each = _by_camera(self.left_out)
        if not np.isfinite(each).any():
            return ()
        low = each < np.nanmedian(each) - CONTRADICTS
        return tuple(name for name, is_low in zip(self.cameras, low, strict=True) if is_low)

    def verdict(self, warnings: tuple[str, ...] = ()) -> tuple[Verdict, tuple[str, ...]]:
        """Say in plain words what to do with the result, and why.

        Parameters
        ----------
        warnings : tuple of str
            What else was found doubtful.
        """
        reasons = list(warnings)
        mean = _mean(self.model)
        if mean < GOOD:
            reasons.append(
                f"The model, drawn into the cameras, agrees with {mean:.0%} of what they see (over {GOOD:.0%} is good)."
            )
        if self.residual > LOOSE:
            reasons.append(
                f"Tracked points are {self.residual:.1%} of the subject's diagonal from where their bodies carry them "
                f"(under {LOOSE:.0%} is good)."
            )
        if self.contradicting:
            reasons.append(f"The silhouettes of {', '.join(self.contradicting)} contradict the other cameras.")
        if not reasons:
            return "trust it", ()
        return ("don't use it" if mean < POOR else "check it"), tuple(reasons)


def _by_camera(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    count = known.sum(axis=1)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)


def _mean(values: np.ndarray) -> float:
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else float("nan")


def _least(values: np.ndarray) -> float:
    each = _by_camera(values)
    return float(np.nanmin(each)) if np.isfinite(each).any() else float("nan")
