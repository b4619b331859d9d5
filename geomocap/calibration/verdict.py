"""A verdict in words: is the calibration good, what is doubtful about it, and what to record again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.calibration.bundle_adjustment import AdjustedNetwork
from geomocap.calibration.calibration_quality import CameraMotion, CameraPrecision, HeldOut, ImageCoverage
from geomocap.calibration.datum import Datum
from geomocap.calibration.stability import Moved


@dataclass(frozen=True)
class Verdict:
    """What to think of a calibration.

    Attributes
    ----------
    grade : {"good", "usable", "poor"}
    summary : str
        One sentence.
    warnings : tuple of str
        What is doubtful, and what to do about it, the gravest first.
    """

    grade: str
    summary: str
    warnings: tuple[str, ...]


def judge(
    adjusted: AdjustedNetwork,
    precision: tuple[CameraPrecision, ...],
    covered: tuple[ImageCoverage, ...],
    moved: tuple[Moved, ...],
    how: CameraMotion,
    lengths: HeldOut,
    datum: Datum,
    lost: np.ndarray,
    rejected: np.ndarray,
    sigma0: float,
) -> Verdict:
    """Judge a calibration.

    Parameters
    ----------
    lost : (C,) float
        Fraction of each camera's frames in which it has targets, but none that fits the bar found by the others.
    rejected : (C,) float
        Fraction of each camera's fitting targets that were left out as outliers.
    sigma0 : float
        For the targets' a-priori standard deviations.
    """
    grave: list[str] = []
    doubtful: list[str] = []
    for m in moved:
        grave.append(
            f"camera {m.camera} was moved between frames {m.before} and {m.after} (turned {m.angle_deg:.2f}°, shifted "
            f"{m.shift * 1000:.0f} mm); only its later position is in the calibration: fasten it and record again"
        )
    grave.extend(how.faults)
    n = adjusted.network
    for p, c in zip(precision, covered, strict=True):
        focal = p.parameters.get("fx")
        if focal is not None and focal[1] > 0.02 * focal[0]:
            grave.append(
                f"camera {p.camera}: its camera constant is known to {100 * focal[1] / focal[0]:.1f} % only; "
                "record more positions there, nearer and farther, and with the bar tilted towards it"
            )
        if p.rays < 30:
            grave.append(
                f"camera {p.camera}: only {p.rays} bar ends observed; record at least 15 positions in its view"
            )
        elif c.fraction < 0.5:
            where = f", nothing in the {c.empty_side}" if c.empty_side else ""
            doubtful.append(
                f"camera {p.camera}: the bar was seen in {100 * c.fraction:.0f} % of its image only{where}; "
                "move it there too, the distortion is extrapolated"
            )
    for k, name in enumerate(n.names):
        if lost[k] > 0.2:
            doubtful.append(
                f"camera {name}: in {100 * lost[k]:.0f} % of its frames no target fits the bar that the others see; "
                "look for reflections, bad synchronization or movement of the camera"
            )
        if rejected[k] > 0.1:
            doubtful.append(f"camera {name}: {100 * rejected[k]:.0f} % of its targets were left out as outliers")
    if sigma0 > 4:
        doubtful.append(
            f"residuals are {sigma0:.1f} times what the targets' precision lets expect: "
            "bar moved while exposed, cameras not quite synchronized, or targets partly hidden"
        )
    if len(n.bars) < 30:
        doubtful.append(f"only {len(n.bars)} bar positions were used; 60 or more, all over the volume, are better")
    relative = lengths.relative
    if not relative < 1 / 300:
        grave.append(f"held-out bars are wrong by {1000 * lengths.rms:.1f} mm (1/{_inverse(relative)} of the volume)")
    doubtful.extend(datum.warnings)
    grade = (
        "poor"
        if grave
        else "good"
        if relative < 1 / 1500 and not doubtful[: -len(datum.warnings) or None]
        else "usable"
    )
    summary = (
        f"{grade.capitalize()} calibration of {len(n.names)} cameras by {len(n.bars)} bar positions: "
        f"held-out bars are right to {1000 * lengths.rms:.2f} mm RMS, "
        f"1/{_inverse(relative)} of the volume of {lengths.diagonal:.1f} m."
    )
    return Verdict(grade, summary, tuple(grave + doubtful))


def _inverse(fraction: float) -> str:
    return f"{1 / fraction:.0f}" if fraction > 0 else "∞"
