"""The one reader and writer of `correction.json`, and of `sparse/` in a run whose calibration was corrected."""

from __future__ import annotations

import json

import numpy as np

from geomocap.errors import RunError
from geomocap.files.atomic import write_text
from geomocap.files.capture import Capture
from geomocap.files.rigs import read_rig, write_rig
from geomocap.files.run import Run
from geomocap.model.camera_correction import CameraCorrection
from geomocap.reading import read_json, reason

CORRECTION, SPARSE = "correction.json", "sparse"
SPARSE_FILES = tuple(f"{SPARSE}/{part}.txt" for part in ("cameras", "images", "points3D", "rigs", "frames"))


def write_cameras(run: Run, found: CameraCorrection) -> None:
    """Write what the silhouettes say of the calibration, and corrected cameras as a COLMAP model."""

    def known(value: float) -> float | None:
        return round(float(value), 3) if np.isfinite(value) else None

    content: dict[str, object] = {"disagreement_px": known(found.before), "left_px": known(found.after)}
    content["corrected"] = found.is_corrected
    if found.is_corrected:
        write_rig(run.path / SPARSE, found.rig)
        moved = 1000 * np.linalg.norm(found.rig.centers - found.given.centers, axis=1)
        content["moved_mm"] = {name: round(float(mm), 1) for name, mm in zip(found.rig.names, moved, strict=True)}
    write_text(run.path / CORRECTION, json.dumps(content, indent=1))


def as_seen(run: Run, capture: Capture) -> Capture:
    """Return the capture with the cameras that a run uses: its own if the calibration was corrected."""
    folder = run.path / SPARSE
    if not run.has(SPARSE_FILES[0]) or not capture.is_calibrated:
        return capture
    return capture.with_rig(read_rig(folder, capture.cameras))


def camera_warnings(run: Run) -> list[str]:
    """Tell the user of a calibration that was corrected; nothing if it wasn't.

    Raises
    ------
    RunError
        If the file is damaged.
    """
    file = run.path / CORRECTION
    if not file.is_file():
        return []
    found = read_json(file, RunError)
    try:
        if not found["corrected"]:
            return []
        before, after = float(found["disagreement_px"]), float(found["left_px"])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise RunError(f"{file}: damaged ({reason(error)}); delete it and run again") from None
    return [
        f"The calibration contradicts the silhouettes by {before:.1f} pixels; cameras corrected by them "
        f"({after:.1f} pixels) were used, {SPARSE}/ of the run. Calibrate again where you can."
    ]
