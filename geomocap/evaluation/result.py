"""What an evaluation found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.model.rotations import turn_angles


class EvaluationError(GeomocapError):
    """A truth that can't be used, or doesn't belong to the run."""


@dataclass(frozen=True)
class Curve:
    """A figure over time.

    Attributes
    ----------
    name : str
    unit : str
    frames : (N,) int
    values : (N,) float
    """

    name: str
    unit: str
    frames: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Match:
    """A found joint or marker and the true one that it was matched with.

    Attributes
    ----------
    found, true : str
    mean_mm, p95_mm : float
        Distance over time.
    frames : int
        In which both are there.
    """

    found: str
    true: str
    mean_mm: float
    p95_mm: float
    frames: int


@dataclass(frozen=True)
class Alignment:
    """How the truth's world and clock were brought onto the run's.

    Attributes
    ----------
    rotation : (3, 3) float
    translation : (3,) float, metres
        `run = rotation @ truth + translation`.
    time_offset : float
        The truth's clock minus the run's, seconds: what the run shows at t stands in the truth at t + time_offset.
    """

    rotation: np.ndarray
    translation: np.ndarray
    time_offset: float

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation."""
        return float(np.rad2deg(turn_angles(self.rotation)))


@dataclass(frozen=True)
class Evaluation:
    """Figures, their course over time, and what was matched with what.

    Attributes
    ----------
    figures : dict of str to int or float
        Lengths in millimetres unless the name says otherwise; `%h` is per cent of the subject's height.
    curves : tuple of Curve
    matches : tuple of Match
    alignment : Alignment or None
        None where truth and run share world and clock.
    """

    figures: dict[str, float]
    curves: tuple[Curve, ...] = ()
    matches: tuple[Match, ...] = ()
    alignment: Alignment | None = None

    def rounded(self) -> dict[str, float]:
        """Figures as they are printed: whole numbers, and others to four digits."""
        return {
            k: round(float(v), 4) if isinstance(v, (float, np.floating)) else int(v) for k, v in self.figures.items()
        }
