"""Tiny runs in one process, whose memory and open files stay flat: `python -m tests.benchmarks.soak [NUMBER]`."""

from __future__ import annotations

import ctypes
import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomocap import pipeline
from geomocap.config import Config, load_config
from geomocap.files.capture import Capture
from geomocap.files.run import Run
from geomocap.files.run_lock import working_in
from geomocap.pipeline import Job
from geomocap.scheduling import threads
from tests.benchmarks.tiny_run import make_tiny, quiet

QUICK = {
    "carving": {"resolution": 32},
    "refinement": {"rounds": 0},
    "motion_bodies": {"depth_rounds": 0},
}


@dataclass(frozen=True)
class Held:
    """What this process holds: resident memory in MB, open files, threads.

    What the C library keeps of freed memory is given back before: how much that is depends on the order in which memory
    was asked for, and it belongs to nobody.
    """

    memory: float
    files: int
    threads: int

    @classmethod
    def now(cls) -> Held:
        gc.collect()
        with suppress(AttributeError):  # of the GNU C library
            ctypes.CDLL(None).malloc_trim(0)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        folders = [len(os.listdir(f"/proc/self/{name}")) for name in ("fd", "task")]
        return cls(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, *folders)


def soak(number: int, folder: Path) -> Iterator[Held]:
    """Make so many runs of a tiny capture, as a program does that uses the library; yield what is held after each."""
    capture, config = make_tiny(folder), load_config(overrides=QUICK)
    for _ in range(number):
        run = Run(folder / "run")
        one_run(capture, run, config)
        shutil.rmtree(run.path)
        yield Held.now()


def one_run(path: Path, run: Run, config: Config) -> None:
    """Take a capture to its motion files."""
    capture = Capture.open(path)
    with working_in(run, "soak"), threads(1) as executor:
        pipeline.motion_files(Job(run, config, executor, capture=capture, fps=capture.fps), "voxels")


def growth(held: list[Held]) -> float:
    """MB per run, by a line through the second half of all."""
    half = [h.memory for h in held[len(held) // 2 :]]
    return float(np.polyfit(np.arange(len(half)), half, 1)[0])


def main(number: int = 200) -> None:
    """Print what is held as the runs go on."""
    held = []
    with quiet() as told, tempfile.TemporaryDirectory() as folder:
        for k, now in enumerate(soak(number, Path(folder))):
            held.append(now)
            if k % 20 == 0 or k == number - 1:
                print(
                    f"run {k + 1}: {now.memory:.1f} MB, {now.files} files, {now.threads} threads", file=told, flush=True
                )
        print(f"growth in the second half: {1000 * growth(held):.1f} kB a run", file=told)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
