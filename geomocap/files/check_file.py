"""The one reader and writer of `check.json`: how well a run's result agrees with its silhouettes."""

from __future__ import annotations

import json

import numpy as np

from geomocap.errors import RunError
from geomocap.files.atomic import write_text
from geomocap.files.run import Run
from geomocap.model.self_check import SelfCheck
from geomocap.reading import read_json, reason

CHECK = "check.json"


def write_self_check(run: Run, check: SelfCheck) -> None:
    """Write `check.json`; what is not known is null there."""

    def rows(values: np.ndarray) -> list[list[float | None]]:
        return [[round(float(v), 4) if np.isfinite(v) else None for v in row] for row in values]

    content = {
        "cameras": list(check.cameras),
        "frames": check.frames.tolist(),
        "model": rows(check.model),
        "left_out": rows(check.left_out),
        "residual": check.residual if np.isfinite(check.residual) else None,
    }
    write_text(run.path / CHECK, json.dumps(content, indent=1))


def read_self_check(run: Run) -> SelfCheck | None:
    """Read `check.json`; None if there is none.

    Raises
    ------
    RunError
        If the file is damaged.
    """
    file = run.path / CHECK
    if not file.is_file():
        return None
    found = read_json(file, RunError)
    try:
        model, left_out = (np.array(found[name], float) for name in ("model", "left_out"))
        residual = float("nan") if found["residual"] is None else float(found["residual"])
        cameras, frames = tuple(str(c) for c in found["cameras"]), np.array(found["frames"], int)
        if model.shape != left_out.shape or model.shape != (len(cameras), len(frames)):
            raise ValueError("its tables have different sizes")
        return SelfCheck(cameras, frames, model, left_out, residual)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise RunError(f"{file}: damaged ({reason(error)}); delete it and run again") from None
