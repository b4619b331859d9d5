"""Tiny runs on disks too small for them, then with room: `python -m tests.benchmarks.full_disk [NUMBER [VARIANT]]`
(voxels, cloud, or report: full while the pictures and the report of review are written; review or export: full while
that command is given on a whole run).

The disk becomes full at files spread over all that are written, first to last. Each must end with one line that says
so, leave no half file, and end with the same files as an undisturbed one once there is room. Mounting must be allowed.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections import Counter
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path
from typing import TextIO

from geomocap.files.atomic import remains
from geomocap.files.run import Run
from geomocap.files.stage_records import read_record, stages
from tests.benchmarks.tiny_run import VARIANTS, command, cut, digests, make_tiny, quiet, run_tiny
from tests.disks import make_larger, small_disk

PACKAGES = {"c3d": "ezc3d", "usd": "pxr", "parquet": "pyarrow", "movement": "xarray"}  # that formats need
FORMATS = [f for f in PACKAGES if find_spec(PACKAGES[f])] + ["bvh", "trc", "glb", "csv", "angles", "osim", "urdf"]
COMMANDS = {"review": ("review",), "export": ("export", *(f"--{f}" for f in FORMATS))}
BLOCK = 4  # kB: a file takes whole ones
ROOM = 200_000  # kB


def limits(run: Path, last: bool = False) -> list[int]:
    """Sizes of disks, kB, that become full at one file after the other of a run, or of its review, which is last."""
    written = sorted(files(run).values(), key=lambda p: p.stat().st_mtime_ns)
    ends = zip(written, accumulate(map(blocks, written)), strict=True)
    return sorted({BLOCK * max(1, used - 1) for p, used in ends if not last or p.parent.name == "review"})


def growing(before: Path, after: Path) -> list[int]:
    """Sizes of disks, kB, that become full at one file after the other that a command writes on a whole run."""
    used, found = sum(map(blocks, files(before).values())), set()
    for name, path in sorted(files(after).items(), key=lambda f: f[1].stat().st_mtime_ns):
        old = files(before).get(name)
        if old is None or old.stat().st_mtime_ns != path.stat().st_mtime_ns:
            found.add(BLOCK * (used + blocks(path) - 1))
            used += blocks(path) - (blocks(old) if old else 0)
    return sorted(found)


def files(run: Path) -> dict[str, Path]:
    """All files of a run by their names."""
    return {str(p.relative_to(run)): p for p in run.rglob("*") if p.is_file()}


def blocks(path: Path) -> int:
    """How many blocks a file takes."""
    return max(1, -(-path.stat().st_size // (BLOCK << 10)))


def told_wrong(told: str) -> list[str]:
    """Say whether a full disk was told otherwise than in one line."""
    lines = [line for line in told.splitlines() if line.startswith("geomocap: ")]
    one = len(lines) == 1 and "No space left on device" in lines[0] and "Traceback" not in told
    return [] if one else [f"says {told[-300:]}"]


def left_wrong(run: Path, *right: dict[str, str]) -> list[str]:
    """Say what is left of a run that is not as in one of those."""
    wrong = [f"{n}: not whole" for n, d in digests(run).items() if d not in [r.get(n) for r in right]]
    wrong += [f"{n}: cut" for n in cut(run)]
    return wrong + [f"{p.name}: temporary" for p in remains(Run(run).folders())]


def judge(whole: Path, capture: Path, disk: Path, more: tuple[str, ...]) -> tuple[str, list[str]]:
    """Run on a disk that is too small, then with room; return where it stopped, and what is wrong."""
    run = disk / "run"
    status, told = run_tiny(capture, run, *more)
    if status == 0:
        return "had room", []
    wrong = told_wrong(told) + left_wrong(run, digests(whole))
    begun = set(stages(run)) >= set(stages(whole))
    stopped = (Run(run).unfinished() or ["review" if begun else "before any stage"])[0]
    make_larger(disk, ROOM)
    return stopped, wrong + with_room(whole, run, run_tiny(capture, run, *more))


def judge_command(before: Path, whole: Path, disk: Path, variant: str) -> tuple[str, list[str]]:
    """Give a command on a run without room, then with; return the file where it stopped, and what is wrong."""
    run = shutil.copytree(before, disk / "run")
    name, *options = COMMANDS[variant]
    status, told = command(name, str(run), *options)
    if status == 0:
        return "had room", []
    wrong = told_wrong(told) + left_wrong(run, digests(before), digests(whole))
    wrong += [f"{n}: lost" for n in sorted(files(before).keys() - files(run).keys())]
    stopped = told.partition(f"{run}/")[2].partition(": can't be written")[0]
    make_larger(disk, ROOM)
    return stopped, wrong + with_room(whole, run, command(name, str(run), *options))


def with_room(whole: Path, run: Path, ended: tuple[object, str]) -> list[str]:
    """Say what is wrong with a run that was gone on with when there was room."""
    status, told = ended
    found, right = digests(run), digests(whole)
    wrong = [f"with room it ends with {status}: {told[-300:]}"] * bool(status)
    wrong += [f"{n}: other content" for n in sorted(right.keys() | found.keys()) if right.get(n) != found.get(n)]
    wrong += [f"{n}: cut, with room" for n in cut(run)]
    wrong += [f"{n}: {fault}" for n, fault in Run(run).faults().items()]
    return wrong + [f"{n}: not there" for n in sorted(files(whole).keys() - files(run).keys())]


def succeed(ended: tuple[object, str], told: TextIO) -> None:
    """Stop if what nothing disturbs fails."""
    status, said = ended
    if status:
        print(f"undisturbed it ends with {status}: {said[-300:]}", file=told)
        sys.exit(1)


def main(number: int = 30, variant: str = "voxels") -> int:
    """Try so many sizes; return how many went wrong."""
    more, bad, places = VARIANTS.get(variant, ()), 0, Counter[str]()
    with quiet() as told, tempfile.TemporaryDirectory() as folder:
        capture, before, whole = make_tiny(Path(folder), variant), Path(folder) / "before", Path(folder) / "whole"
        succeed(run_tiny(capture, before if variant in COMMANDS else whole, *more), told)
        if variant in COMMANDS:
            shutil.copytree(before, whole)
            succeed(command(COMMANDS[variant][0], str(whole), *COMMANDS[variant][1:]), told)
        sizes = growing(before, whole) if variant in COMMANDS else limits(whole, last=variant == "report")
        for n, size in enumerate(sizes[:: max(1, len(sizes) // number)]):
            with small_disk(Path(folder) / f"disk{n}", size) as disk:
                if variant in COMMANDS:
                    where, wrong = judge_command(before, whole, disk, variant)
                else:
                    where, wrong = judge(whole, capture, disk, more)
                shutil.rmtree(disk / "run", ignore_errors=True)
            places[where] += 1
            bad += bool(wrong)
            print(f"{size} kB: {where}{': ' * bool(wrong)}{'; '.join(wrong[:5])}", file=told, flush=True)
        wanted = [s for s in stages(whole) if read_record(whole, s).files] if variant in ("voxels", "cloud") else []
        wanted = ["review"] if variant == "report" else wanted
        missed = [stage for stage in wanted if stage not in places]
        found = ", ".join(f"{n} {place}" for place, n in places.most_common())
        print(f"{sum(places.values())} sizes, {bad} of them wrong; {found}; not hit: {missed or 'none'}", file=told)
    return bad


if __name__ == "__main__":
    sys.exit(1 if main(*map(int, sys.argv[1:2]), *sys.argv[2:3]) else 0)
