"""A tiny run in windows on a Dask cluster with killed workers: `python -m tests.benchmarks.cluster [NUMBER [SEED]]`.

Two workers of one thread, one worker of two threads, and threads alone must give the same files; so must runs in each
of which a worker is killed at some moment, from the first stage to the last.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

from distributed import LocalCluster

from geomocap.files.run import Run
from tests.benchmarks.tiny_run import VARIANTS, digests, make_tiny, run_tiny

WINDOWS = VARIANTS["windows"]


def on_cluster(capture: Path, run: Path, workers: int, threads: int, moment: float | None = None) -> tuple[float, str]:
    """Make a run on a cluster, killing a worker after `moment` seconds; return the seconds, and what was killed."""
    killed: list[str] = []
    with LocalCluster(
        n_workers=workers, threads_per_worker=threads, dashboard_address=None, host="127.0.0.1"
    ) as cluster:

        def kill() -> None:
            process = random.choice(list(cluster.workers.values())).pid
            killed.append(", ".join(Run(run).unfinished()) or "between stages")
            os.kill(process, signal.SIGKILL)

        timer = threading.Timer(moment or 0.0, kill)
        if moment is not None:
            timer.start()
        begin = time.perf_counter()
        status, told = run_tiny(capture, run, *WINDOWS, "--scheduler", cluster.scheduler_address)
        seconds = time.perf_counter() - begin
        timer.cancel()
    if status:
        raise SystemExit(f"the run ended with {status}: {told[-500:]}")
    return seconds, "".join(killed)


def main(number: int = 6, seed: int = 0) -> int:
    """Print a line for each run, and return how many were wrong."""
    random.seed(seed)
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        capture = make_tiny(folder, "windows")
        run_tiny(capture, folder / "threads", *WINDOWS)
        expected = digests(folder / "threads")

        def judged(label: str, run: Path) -> int:
            made = digests(run)
            differ = [name for name in expected | made if expected.get(name) != made.get(name)]
            print(
                f"{label}: {f'{len(differ)} files differ ({differ[0]} …)' if differ else 'the same files'}", flush=True
            )
            shutil.rmtree(run)
            return bool(differ)

        seconds = 0.0
        for workers, threads in ((1, 2), (2, 1)):
            seconds, _ = on_cluster(capture, folder / "cluster", workers, threads)
            wrong += judged(f"{workers} × {threads} threads, {seconds:.1f} s", folder / "cluster")
        for k in range(number):
            moment = seconds * (k + random.random()) / number
            _, stage = on_cluster(capture, folder / "cluster", 2, 1, moment)
            wrong += judged(
                f"a worker killed after {moment:.1f} s ({stage or 'the run had ended'})", folder / "cluster"
            )
    print(f"{wrong} of {2 + number} wrong; {len(expected)} files compared")
    return wrong


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])) > 0)
