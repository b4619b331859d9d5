"""Tiny runs in one process, whose memory and open files stay flat: `python -m tests.benchmarks.soak [NUMBER]`."""

from __future__ import annotations

import ctypes
import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
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


class _Heap(ctypes.Structure):
    """What the GNU C library's allocator says of itself (`mallinfo2`)."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    )


@dataclass(frozen=True)
class Held:
    """What this process holds: memory that was asked for and not given back in MB, open files, threads.

    Resident memory tells less: by how free memory lies in pieces it changes by a megabyte from run to run, memory in
    use by a hundredth of one. It is taken where the C library isn't GNU's, version 2.33 or newer.
    """

    memory: float
    files: int
    threads: int

    @classmethod
    def now(cls) -> Held:
        gc.collect()
        folders = [len(os.listdir(f"/proc/self/{name}")) for name in ("fd", "task")]
        return cls(_in_use() / 1e6, *folders)


def _in_use() -> int:
    """Memory in use, bytes: arrays and images, of any library."""
    try:
        told = ctypes.CDLL(None).mallinfo2
    except AttributeError:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    told.restype = _Heap
    heap = told()
    return heap.uordblks + heap.hblkhd


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
