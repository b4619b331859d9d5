"""Kill tiny runs at random moments and start them again: `python -m tests.benchmarks.killed [NUMBER [VARIANT [SEED]]]`.

Each run must leave no half file when it is killed, and end with the same files as an undisturbed one, nothing temporary
among them. The moments are spread over all the processor time of a run, from the first stage to the last motion file.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.context import ForkServerContext
from pathlib import Path

from geomocap.files.atomic import remains
from geomocap.files.run import Run
from tests.benchmarks.tiny_run import VARIANTS, digests, make_tiny, quiet, run_tiny

PREPARED = ["geomocap.cli", "geomocap.pipeline", "viz", "open3d", "tests.benchmarks.tiny_run"]
TICK = 0.002  # s


def prepared() -> ForkServerContext:
    """Processes that have imported everything when they begin, so that hundreds can be made."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PREPARED)
    return context


def killed(context: ForkServerContext, capture: Path, run: Path, moment: float, *more: str) -> float:
    """Begin a run in another process, kill it after some seconds of processor time; return how long it had.

    That is less than `moment` if the run ended before.
    """
    process, spent = context.Process(target=run_tiny, args=(capture, run, *more)), 0.0
    process.start()
    assert process.pid is not None
    first: float | None = None
    while process.is_alive():
        now = _processor_seconds(process.pid)
        if first is None and (run / "run.toml").exists():
            first = now
        if first is not None and now is not None:
            spent = now - first
            if spent >= moment:
                process.kill()
                break
        time.sleep(TICK)
    process.join()
    return spent


def _processor_seconds(number: int) -> float | None:
    try:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def judge(
    context: ForkServerContext, whole: dict[str, str], capture: Path, run: Path, moment: float, *more: str
) -> tuple[str, list[str]]:
    """Kill a run, start it again here; return the stage that it was in, and what is wrong with it."""
    under_way = killed(context, capture, run, moment, *more) >= moment
    stages = Run(run).unfinished()
    temporary = {str(p.relative_to(run)) for p in remains(Run(run).folders())}
    # what stands under its name is whole if it is what an undisturbed run leaves there
    wrong = [f"{n}: not whole" for n, d in digests(run).items() if whole.get(n) != d and n not in temporary]
    status, told = run_tiny(capture, run, *more)
    if status:
        wrong.append(f"started again it ends with {status}: {told[-300:]}")
    found = digests(run)
    wrong += [f"{n}: other content" for n in sorted(whole.keys() | found.keys()) if whole.get(n) != found.get(n)]
    where = "had ended" if not under_way else stages[0] if stages else "between stages"
    return where + (", with a temporary file" if temporary else ""), wrong


def main(number: int = 100, variant: str = "voxels", seed: int = 0) -> int:
    """Kill so many runs; return how many went wrong."""
    more, context = VARIANTS[variant], prepared()
    chance, bad, places = random.Random(seed), 0, Counter[str]()
    with quiet() as told, tempfile.TemporaryDirectory() as folder:
        capture, run = make_tiny(Path(folder), variant), Path(folder) / "run"
        run_tiny(capture, Path(folder) / "whole", *more)
        whole = digests(Path(folder) / "whole")
        seconds = killed(context, capture, run, 600, *more)
        shutil.rmtree(run)
        for k in range(number):
            # one in each of so many equal parts of the time
            where, wrong = judge(context, whole, capture, run, (k + chance.random()) / number * seconds, *more)
            places[where] += 1
            bad += bool(wrong)
            if wrong:
                print(f"{k}: {where}: {'; '.join(wrong[:5])}", file=told, flush=True)
            elif k % 10 == 9:
                print(f"{k + 1} killed", file=told, flush=True)
            shutil.rmtree(run)
        found = ", ".join(f"{n} {place}" for place, n in places.most_common())
        print(f"{len(whole)} files, {seconds:.1f} s; {number} killed, {bad} of them wrong; {found}", file=told)
    return bad


if __name__ == "__main__":
    arguments = sys.argv[1:]
    sys.exit(1 if main(*map(int, arguments[:1]), *arguments[1:2], *map(int, arguments[2:])) else 0)
