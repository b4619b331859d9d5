"""What the arrays of a file must be: shapes that belong together, and numbers that can be what their names say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from geomocap.errors import GeometryError
from geomocap.settings import LEAST_FPS, MOST_FPS

Kind = Literal["number", "whole", "truth", "text", "rotation", "direction"]

LARGEST = 1e9  # of any number in a result: metres, degrees, frames
WRITTEN = 1e-3  # as far may rotations be from orthonormal, and directions from unit length
_KINDS = {"number": "fiu", "whole": "iu", "truth": "b", "text": "US", "rotation": "f", "direction": "f"}


@dataclass(frozen=True)
class Expected:
    """One array.

    Attributes
    ----------
    shape : str
        Sizes with spaces between, a letter where a size is the same in all arrays: "T B 3 3". Empty: a single value.
    kind : str
        What it holds; rotations are orthonormal, directions of unit length, whole numbers may stand as floats.
    gaps : bool
        Whether some may be NaN; of directions, zero.
    low, high : float or str
        Least and largest; a letter is the size of that name less one, which a number (an index) may be at the most.
    """

    shape: str
    kind: Kind = "number"
    gaps: bool = False
    low: float = -LARGEST
    high: float | str = LARGEST


FPS = Expected("", low=LEAST_FPS, high=MOST_FPS)


def check_arrays(found: Mapping[str, np.ndarray], schema: Mapping[str, Expected], **sizes: int) -> dict[str, int]:
    """Check the arrays that are there, in the order of the schema; return the sizes by their letters.

    Raises
    ------
    GeometryError
        Naming the first array that has another shape, or holds what it can't.
    """
    known = dict(sizes)
    for name, expected in schema.items():
        if name in found:
            _check_shape(name, np.shape(found[name]), expected, known)
    for name, expected in schema.items():
        if name in found:
            _check_values(name, np.asarray(found[name]), expected, known)
    return known


def _check_shape(name: str, shape: tuple[int, ...], expected: Expected, known: dict[str, int]) -> None:
    words = expected.shape.split()
    wanted = [int(w) if w.isdecimal() else known.get(w) for w in words]
    if len(shape) != len(words) or any(w is not None and w != n for w, n in zip(wanted, shape, strict=False)):
        said = (
            " × ".join(str(n if n is not None else w) for n, w in zip(wanted, words, strict=True)) or "a single value"
        )
        raise GeometryError(f"{name} has the shape {shape}, expected {said}")
    known.update({w: n for w, n in zip(words, shape, strict=True) if not w.isdecimal()})


def _check_values(name: str, values: np.ndarray, expected: Expected, known: dict[str, int]) -> None:
    if not values.size:
        return
    kind = values.dtype.kind
    if kind not in _KINDS[expected.kind] and not (expected.kind == "whole" and kind == "f" and _is_whole(values)):
        raise GeometryError(f"{name} holds {values.dtype.name} values, expected {_WORDS[expected.kind]}")
    if kind not in "fiu":
        return
    missing = np.isnan(values) if kind == "f" else np.zeros(values.shape, bool)
    if missing.any() and not expected.gaps:
        raise GeometryError(f"{name} holds {int(missing.sum())} values that are NaN")
    there = values[~missing]
    if kind == "f" and np.isinf(there).any():
        raise GeometryError(f"{name} holds infinite values")
    high = known[expected.high] - 1 if isinstance(expected.high, str) else expected.high
    if len(there) and not (expected.low <= there.min() and there.max() <= high):
        wrong = there.min() if there.min() < expected.low else there.max()
        verb = "holds" if expected.shape else "is"
        raise GeometryError(f"{name} {verb} {wrong:.6g}, expected {expected.low:g} to {high:g}")
    if expected.kind == "rotation":
        _check_rotations(name, values[~missing.any(axis=(-2, -1))])
    elif expected.kind == "direction":
        lengths = np.linalg.norm(values, axis=-1)
        good = (np.abs(lengths - 1) <= WRITTEN) | (expected.gaps & ((lengths == 0) | np.isnan(lengths)))
        if not good.all():
            raise GeometryError(f"{name} holds {int((~good).sum())} directions that are not of unit length")


def _check_rotations(name: str, rotations: np.ndarray) -> None:
    if not len(rotations):
        return
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    if off.max() > 2 * WRITTEN:
        raise GeometryError(f"{name} holds {int((off > 2 * WRITTEN).sum())} matrices that are no rotations")
    if (np.linalg.det(rotations) < 0).any():
        raise GeometryError(f"{name} holds rotations that mirror (determinant −1)")


def _is_whole(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and (values == np.rint(values)).all())


_WORDS = {
    "number": "numbers",
    "whole": "whole numbers",
    "truth": "true or false",
    "text": "texts",
    "rotation": "rotations",
    "direction": "directions",
}


def quiet_nan(values: np.ndarray) -> np.ndarray:
    """Return numbers of a file without signalling NaN, which make arithmetic warn; they are NaN like others then."""
    if values.dtype.kind != "f" or not (missing := np.isnan(values)).any():
        return values
    values = values.copy()
    values[missing] = np.nan
    return values
