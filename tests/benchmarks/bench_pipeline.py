"""The whole way from PNG images to skeleton.npz, and how its memory grows with the number of frames."""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from data_tools.figure import figure
from data_tools.synthesize import SynthesisSettings, synthesize
from tests.benchmarks.table import Row

PERIOD, FRAMES, CAMERAS = 30, 220, 8  # the figure's motion lasts 2 s: its frames repeat after 30 at 15 fps
FAST = ["--carving.consistency.enabled", "false", "--segmentation.method", "m3", "--no-pictures"]


def benchmark() -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        settings = SynthesisSettings(cameras=CAMERAS, width=320, height=240, fps=15, frames=PERIOD)
        synthesize(figure(), root / "once", root / "truth", settings)
        long, short = _repeat(root / "once", root / "long", FRAMES), _repeat(root / "once", root / "short", FRAMES // 4)
        _, few = _measure(short, root / "warm")  # compiles what is not compiled
        runs = [_measure(long, root / f"run{k}") for k in range(3)]
        seconds, many = median([r[0] for r in runs]), runs[-1][1]
        cold, warm = _first_use(root)
        stages = json.loads((root / "run2" / "timings.json").read_text())
    fractions = ", ".join(f"{name} {stage['seconds']:.1f} s" for name, stage in stages.items())
    return [
        Row(
            f"{FRAMES} frames × {CAMERAS} cameras 320×240, PNG to skeleton and motion files, 256³, m3",
            seconds,
            f"the recording itself ({FRAMES / 15:.1f} s)",
            FRAMES / 15,
            "≤ 8 s after compilation, on 2 cores; flat memory",
            f"{fractions}; peak {many:.0f} MB, {few:.0f} MB with {FRAMES // 4} frames",
        ),
        Row(
            "geomocap demo for the first time: what it takes longer than the next time, compilation",
            cold - warm,
            "the whole of it",
            cold,
            "≤ 25 s, on 2 cores",
        ),
        Row(
            f"start of the command line ({sys.executable.rsplit('/', 1)[-1]} -m geomocap --help)",
            _call(["--help"])[0],
            "",
            math.nan,
            "",
            "",
        ),
    ]


def _first_use(root: Path) -> tuple[float, float]:
    """Wall times of the demo with no kernel compiled, and with all of them."""
    cache = {"NUMBA_CACHE_DIR": str(root / "kernels")}
    cold, warm = (_call(["demo", str(root / name)], cache)[0] for name in ("first", "second"))
    return cold, warm


def _repeat(source: Path, target: Path, frames: int) -> Path:
    """Make a longer capture of hard links."""
    for file in source.rglob("*"):
        if file.is_file() and "images" not in file.parts:
            place = target / file.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.link(file, place)
    for camera in (source / "images").iterdir():
        (target / "images" / camera.name).mkdir(parents=True)
        for k in range(frames):
            os.link(camera / f"{k % PERIOD:06d}.png", target / "images" / camera.name / f"{k:06d}.png")
    return target


def _measure(capture: Path, run: Path) -> tuple[float, float]:
    return _call(["run", str(capture), str(run), *FAST])


def _call(arguments: list[str], environment: dict[str, str] | None = None) -> tuple[float, float]:
    """Wall time of a call in seconds, and the highest resident memory of any call so far in MB."""
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "geomocap", *arguments],
        check=True,
        capture_output=True,
        env={**os.environ, **(environment or {})},
    )
    return time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
