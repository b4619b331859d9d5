"""Kill tiny runs at random moments and start them again: `python -m tests.benchmarks.killed [NUMBER [SEED]]`.

Each run must leave no half file when it is killed, and end with the same files as an undisturbed one, nothing temporary
among them. The moments are spread over the whole run, from the first stage to the last motion file.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from geomocap.files.atomic import remains
from geomocap.files.run import Run
from tests.benchmarks.tiny_run import QUICK, digests, make_tiny, run_tiny


def killed(capture: Path, run: Path, moment: float) -> bool:
    """Begin a run in another process, kill it some seconds after its first file; say whether it was still under way."""
    command = [sys.executable, "-m", "geomocap", "run", str(capture), str(run), *QUICK]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (run / "run.toml").exists() and process.poll() is None:
        time.sleep(0.002)
    try:
        return process.wait(moment) != 0
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait() != 0


def judge(whole: dict[str, str], capture: Path, run: Path, moment: float) -> tuple[str, list[str]]:
    """Kill a run, start it again here; return the stage that it was in, and what is wrong with it."""
    under_way, stages = killed(capture, run, moment), Run(run).unfinished()
    temporary = {str(p.relative_to(run)) for p in remains(Run(run).folders())}
    # what stands under its name is whole if it is what an undisturbed run leaves there
    wrong = [f"{n}: not whole" for n, d in digests(run).items() if whole.get(n) != d and n not in temporary]
    status, told = run_tiny(capture, run)
    if status:
        wrong.append(f"started again it ends with {status}: {told[-300:]}")
    found = digests(run)
    wrong += [f"{n}: other content" for n in sorted(whole.keys() | found.keys()) if whole.get(n) != found.get(n)]
    where = "had ended" if not under_way else stages[0] if stages else "between stages"
    return where + (", with a temporary file" if temporary else ""), wrong


def main(number: int = 100, seed: int = 0) -> int:
    """Kill so many runs; return how many went wrong."""
    told = os.fdopen(os.dup(1), "w")
    for stream in (1, 2):  # Open3D's surface reconstruction talks
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    chance, bad, places = random.Random(seed), 0, Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        capture, run = make_tiny(Path(folder)), Path(folder) / "run"
        run_tiny(capture, Path(folder) / "whole")
        whole = digests(Path(folder) / "whole")
        start = time.monotonic()
        killed(capture, run, 600)
        seconds = 0.8 * (time.monotonic() - start)  # the rest is the start of Python
        shutil.rmtree(run)
        for k in range(number):
            where, wrong = judge(whole, capture, run, chance.uniform(0, seconds))
            places[where] += 1
            bad += bool(wrong)
            if wrong:
                print(f"{k}: {where}: {'; '.join(wrong[:5])}", file=told, flush=True)
            shutil.rmtree(run)
    found = ", ".join(f"{n} {place}" for place, n in places.most_common())
    print(f"{len(whole)} files, {seconds:.1f} s; {number} killed, {bad} of them wrong; {found}", file=told)
    return bad


if __name__ == "__main__":
    sys.exit(1 if main(*map(int, sys.argv[1:])) else 0)
