"""A whole run stage by stage, from images to skeleton and motion files: seconds and memory of each."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from data_tools.figure import figure
from data_tools.synthesize import SynthesisSettings, synthesize
from tests.benchmarks.table import Row

FRAMES, CAMERAS, WIDTH, HEIGHT = 60, 8, 640, 480
WARM_UP = 12  # frames of a run that compiles what is not compiled
GOAL = 45  # seconds for all stages


def benchmark() -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for name, frames in (("short", WARM_UP), ("capture", FRAMES)):
            settings = SynthesisSettings(cameras=CAMERAS, width=WIDTH, height=HEIGHT, fps=30, frames=frames)
            synthesize(figure(), root / name, root / f"{name}_truth", settings)
        _call("run", root / "short", root / "warm", "--no-pictures")
        run = root / "run"
        peaks = {stage: _call(stage, root / "capture", run) for stage in ("silhouettes", "voxels", "track")}
        last = _call("run", root / "capture", run, "--no-pictures")
        timings = json.loads((run / "timings.json").read_text())
    spent = {name: stage["seconds"] for name, stage in timings.items()}
    inside = [name for name in ("motion", "model", "outlines") if name in spent]  # of the segmentation
    spent["segmentation"] -= sum(spent[name] for name in inside)
    size = f"{FRAMES} frames × {CAMERAS} cameras {WIDTH}×{HEIGHT}"
    peaks["tracks"] = peaks.pop("track")
    rows = [
        Row(f"{name}, {size}", seconds, note=f"peak {peaks.get(name, last):.0f} MB" + _shared(name, peaks))
        for name, seconds in spent.items()
    ]
    rows.append(Row(f"all stages, {size}", sum(spent.values()), goal=f"≤ {GOAL} s on 2 quiet cores"))
    return rows


def _shared(name: str, peaks: dict[str, float]) -> str:
    return "" if name in peaks else " (of the whole run, one process)"


def _call(command: str, *arguments: Path | str) -> float:
    """Call the command line; return its highest resident memory, MB."""
    line = [sys.executable, "-m", "geomocap", command, *map(str, arguments)]
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, line)
    return usage.ru_maxrss / 1024
