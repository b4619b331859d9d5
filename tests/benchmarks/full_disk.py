"""Tiny runs on disks too small for them, then with room: `python -m tests.benchmarks.full_disk [NUMBER [VARIANT]]`
(voxels, cloud, or report: full while the pictures and the report of review are written).

The disk becomes full at files spread over the whole run, first to last. Each run must end with one line that says so,
leave no half file, and end with the same files as an undisturbed one once there is room. Mounting must be allowed.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections import Counter
from itertools import accumulate
from pathlib import Path

from geomocap.files.atomic import remains
from geomocap.files.run import Run
from geomocap.files.stage_records import read_record, stages
from tests.benchmarks.tiny_run import VARIANTS, cut, digests, make_tiny, quiet, run_tiny
from tests.disks import make_larger, small_disk

BLOCK = 4  # kB: a file takes whole ones
ROOM = 200_000  # kB


def limits(run: Path, last: bool = False) -> list[int]:
    """Sizes of disks, kB, that become full at one file after the other of a run, or of its review, which is last."""
    files = sorted((p for p in run.rglob("*") if p.is_file()), key=lambda p: p.stat().st_mtime_ns)
    blocks = [max(1, -(-p.stat().st_size // (BLOCK << 10))) for p in files]
    ends = zip(files, accumulate(blocks), strict=True)
    return sorted({BLOCK * max(1, used - 1) for p, used in ends if not last or p.parent.name == "review"})


def named(run: Path) -> set[str]:
    """Name all files of a run."""
    return {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}


def judge(whole: Path, capture: Path, disk: Path, more: tuple[str, ...]) -> tuple[str, list[str]]:
    """Run on a disk that is too small, then with room; return where it stopped, and what is wrong."""
    run, right = disk / "run", digests(whole)
    status, told = run_tiny(capture, run, *more)
    if status == 0:
        return "had room", []
    lines = [line for line in told.splitlines() if line.startswith("geomocap: ")]
    wrong = []
    if len(lines) != 1 or "No space left on device" not in lines[0] or "Traceback" in told:
        wrong.append(f"says {told[-300:]}")
    wrong += [f"{n}: not whole" for n, d in digests(run).items() if right.get(n) != d]
    wrong += [f"{n}: cut" for n in cut(run)]
    wrong += [f"{p.name}: temporary" for p in remains(Run(run).folders())]
    begun = set(stages(run)) >= set(stages(whole))
    stopped = (Run(run).unfinished() or ["review" if begun else "before any stage"])[0]
    make_larger(disk, ROOM)
    status, told = run_tiny(capture, run, *more)
    if status:
        wrong.append(f"with room it ends with {status}: {told[-300:]}")
    found = digests(run)
    wrong += [f"{n}: other content" for n in sorted(right.keys() | found.keys()) if right.get(n) != found.get(n)]
    wrong += [f"{n}: cut, with room" for n in cut(run)]
    wrong += [f"{n}: not there" for n in sorted(named(whole) - named(run))]
    return stopped, wrong


def main(number: int = 30, variant: str = "voxels") -> int:
    """Try so many sizes; return how many went wrong."""
    more, bad, places = VARIANTS[variant], 0, Counter[str]()
    with quiet() as told, tempfile.TemporaryDirectory() as folder:
        capture, whole = make_tiny(Path(folder), variant), Path(folder) / "whole"
        status, said = run_tiny(capture, whole, *more)
        if status:
            raise SystemExit(f"the undisturbed run ends with {status}: {said[-300:]}")
        sizes = limits(whole, last=variant == "report")
        for n, size in enumerate(sizes[:: max(1, len(sizes) // number)]):
            with small_disk(Path(folder) / f"disk{n}", size) as disk:
                where, wrong = judge(whole, capture, disk, more)
                shutil.rmtree(disk / "run", ignore_errors=True)
            places[where] += 1
            bad += bool(wrong)
            print(f"{size} kB: {where}{': ' * bool(wrong)}{'; '.join(wrong[:5])}", file=told, flush=True)
        wanted = ["review"] if variant == "report" else [s for s in stages(whole) if read_record(whole, s).files]
        missed = [stage for stage in wanted if stage not in places]
        found = ", ".join(f"{n} {place}" for place, n in places.most_common())
        print(f"{sum(places.values())} sizes, {bad} of them wrong; {found}; not hit: {missed or 'none'}", file=told)
    return bad


if __name__ == "__main__":
    sys.exit(1 if main(*map(int, sys.argv[1:2]), *sys.argv[2:3]) else 0)
