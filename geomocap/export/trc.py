"""TRC (track row column), the marker format of OpenSim: written and read.

Axes y up; the unit stands in the header; gaps are empty fields, which OpenSim reads as not a number.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from geomocap.export.conventions import TRC, UNITS_PER_METRE, Axis, Convention
from geomocap.export.export_errors import MotionError
from geomocap.export.markers import Markers
from geomocap.export.motion_text import ends_early, read_motion_text
from geomocap.files.atomic import write_text

DECIMALS = {"mm": 4, "m": 7}


def write_trc(path: Path, markers: Markers, *, unit: Literal["m", "mm"] = "mm") -> None:
    """Write markers as TRC, whole or not at all.

    Parameters
    ----------
    path : Path
    markers : Markers
    unit : "m" or "mm"
    """
    write_text(path, trc_text(markers, path.name, unit))


def trc_text(markers: Markers, name: str, unit: Literal["m", "mm"] = "mm") -> str:
    """Return the TRC of markers, converted to its axes and `unit`."""
    for label in markers.names:
        if any(c in label for c in "\t\r\n"):
            raise MotionError(f"{name}: marker {label!r} has a tab or line break in its name")
    T, K = markers.n_frames, len(markers.names)
    values = Convention(TRC.up, unit).points(markers.positions, markers.up)
    values = np.round(values, DECIMALS[unit]) + 0.0
    rate = f"{markers.fps:.10g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{T}\t{K}\t{unit}\t{rate}\t1\t{T}",
        "Frame#\tTime\t" + "\t\t\t".join(markers.names) + "\t\t",
        "\t\t" + "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, K + 1)),
        "",
    ]
    point = "\t".join([f"%.{DECIMALS[unit]}f"] * 3)
    for t, (row, present) in enumerate(zip(values, markers.present, strict=True)):
        fields = [point % tuple(p) if ok else "\t\t" for p, ok in zip(row.tolist(), present.tolist(), strict=True)]
        lines.append(f"{t + 1}\t{t / markers.fps:.6f}\t" + "\t".join(fields))
    return "\n".join(lines) + "\n"


def read_trc(path: Path, *, up: Axis = "y") -> Markers:
    """Read a TRC file of any program, in metres.

    Parameters
    ----------
    path : Path
    up : "x", "y" or "z"
        The file's axis that points up, which TRC can't say.

    Raises
    ------
    MotionError
        If the file is no TRC, broken off, names a marker twice or an unknown unit, or its rate contradicts its times.
    """
    text = read_motion_text(path)
    lines = text.splitlines()
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise MotionError(f"{path}: no TRC, it doesn't begin with PathFileType and five header lines")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = header.get("Units", "").strip().lower()
    if unit not in UNITS_PER_METRE:
        raise MotionError(f"{path}: Units is {unit!r}; expected one of {', '.join(UNITS_PER_METRE)}")
    try:
        fps, n_frames = float(header["DataRate"]), int(header["NumFrames"])
    except (KeyError, ValueError):
        raise MotionError(f"{path}: the header lacks a number for DataRate or NumFrames") from None
    names = [n.strip() for n in lines[3].rstrip("\t\r ").split("\t")[2:]][::3]
    body = [line for line in lines[5:] if line.strip()]
    if len(body) != n_frames:
        raise MotionError(
            f"{path}: the header says {n_frames} frames, the file holds {len(body)}; it was cut off or edited"
        )
    if ends_early(text) or (text[-1] not in "\r\n" and body[-1].count("\t") < max(row.count("\t") for row in body)):
        raise MotionError(f"{path}: its last row is shorter than the others and has no line end; it was cut off")
    times, positions = _rows(body, len(names), path)
    if not (np.isfinite(fps) and fps > 0):
        raise MotionError(f"{path}: DataRate is {fps}; expected a positive number of frames per second")
    _check_rate(times, fps, path)
    try:
        return Markers(tuple(names), positions / UNITS_PER_METRE[unit], fps, up)
    except MotionError as error:
        raise MotionError(f"{path}: {error}") from None


def _rows(lines: list[str], n_markers: int, path: Path) -> tuple[np.ndarray, np.ndarray]:
    width = 2 + 3 * n_markers
    values = np.full((len(lines), width), np.nan)
    for t, line in enumerate(lines):
        fields = line.rstrip("\r\n").split("\t")[:width]
        try:
            values[t, : len(fields)] = [float(f) if f.strip() else np.nan for f in fields]
        except ValueError as error:
            raise MotionError(f"{path}: row {t + 1} holds something that is no number ({error})") from None
    return values[:, 1], values[:, 2:].reshape(len(lines), n_markers, 3)


def _check_rate(times: np.ndarray, fps: float, path: Path) -> None:
    if len(times) < 2 or not np.isfinite(times).all():
        return
    seconds, steps = times[-1] - times[0], len(times) - 1
    if not 0.99 < seconds * fps / steps < 1.01:
        measured = steps / seconds if seconds > 1e-9 else np.inf
        raise MotionError(
            f"{path}: DataRate says {fps:g} frames per second, the Time column {measured:g}; correct whichever is wrong"
        )
