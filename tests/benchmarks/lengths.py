"""How time and memory grow with a recording's length: `python -m tests.benchmarks.lengths FOLDER ASSET [FRAMES …]`.

ASSET is what `geomocap synthesize` takes; its clip is played in a loop while the subject wanders, so that no frame
repeats. Each length is a whole run by the command line, from images to motion files, and is judged by the truth. What
FOLDER holds already is not done again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

CAPTURE = ("--cameras", "8", "--width", "320", "--height", "240", "--wander", "0.3")
FIGURES = {
    "bodies": "bodies.found",
    "core": "bodies.core_adjusted_rand_index",
    "recall 5 %": "joints.recall_at_5%h",
    "error mm": "joints.mean_error",
    "edges": "skeleton.true_edges_found",
    "false": "skeleton.false_edges",
    "rotation °": "motion.body_rotation_error_deg",
}


def call(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "geomocap", *arguments], check=True, capture_output=True)


def measured(folder: Path, asset: str, frames: int) -> dict[str, float]:
    """Make and run a recording of so many frames, and judge it; seconds of processor and wall, peak memory in MB."""
    place = folder / f"{frames:06d}"
    kept = place / "figures.json"
    if kept.is_file():
        return dict(json.loads(kept.read_text()))
    if not (place / "capture" / "capture.toml").is_file():
        places = (str(place / "capture"), "--truth", str(place / "truth"))
        call("synthesize", asset, *places, "--frames", str(frames), *CAPTURE)
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "geomocap", "run", str(place / "capture"), str(place / "run"), "--no-pictures"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{place / 'run'}: the run ended with {os.waitstatus_to_exitcode(status)}")
    found = {
        "wall s": time.perf_counter() - begin,
        "processor s": used.ru_utime + used.ru_stime,
        "peak MB": used.ru_maxrss / 1024,
    }
    judged = place / "judged.json"
    call("evaluate", str(place / "run"), str(place / "truth"), "--json", str(judged))
    scores = json.loads(judged.read_text())
    found |= {name: scores[key] for name, key in FIGURES.items() if key in scores}
    kept.write_text(json.dumps(found))
    return found


def main(folder: Path, asset: str, lengths: list[int]) -> None:
    """Print a row for each length."""
    names = ["processor s a frame", "wall s a frame", "peak MB", *FIGURES]
    print("| frames | " + " | ".join(names) + " |\n|---" + "|---" * len(names) + "|")
    for frames in lengths:
        found = measured(folder, asset, frames)
        values = [found["processor s"] / frames, found["wall s"] / frames, found["peak MB"]]
        values += [found.get(name, float("nan")) for name in FIGURES]
        print(
            f"| {frames:,} | " + " | ".join(f"{v:.3g}" if v < 100 else f"{v:,.0f}" for v in values) + " |", flush=True
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], [int(n) for n in sys.argv[3:]] or [60, 240, 960, 3840])
