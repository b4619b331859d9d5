"""Runs that lose nothing: damaged files made again, no room and then room, two at once, killed, many in a row."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from geomocap.files.run import Run
from geomocap.files.run_lock import working_in
from geomocap.inspection import describe
from tests.benchmarks import killed, soak
from tests.benchmarks.tiny_run import digests, make_tiny, run_tiny
from tests.disks import make_larger, no_file_beyond, small_disk
from tests.geomocap.test_files_writing import content


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    return make_tiny(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="session")
def whole(tiny, tmp_path_factory) -> Path:
    """An undisturbed run."""
    run = tmp_path_factory.mktemp("whole") / "run"
    status, told = run_tiny(tiny, run)
    assert status == 0, told
    return run


@pytest.fixture
def run(whole, tmp_path) -> Path:
    """A copy of the run that a test may damage."""
    return shutil.copytree(whole, tmp_path / "run")


def test_what_is_missing_cut_or_replaced_is_told_and_made_again(run, whole, tiny, geomocap):
    (run / "voxels" / "000001.ply").unlink()
    mask = run / "silhouettes" / "cam02" / "000000.png"
    mask.write_bytes(mask.read_bytes()[:50])
    (run / "model.npz").write_bytes((run / "model.npz").read_bytes()[::-1])
    (run / "motion.bvh").unlink()
    (run / "voxels" / "letter.txt").write_text("dear")
    problems = " / ".join(describe(run).problems)
    said = [
        "voxels/000001.ply is missing",
        "000000.png is cut (50 of",
        "model.npz is replaced",
        "motion.bvh is missing",
    ]
    assert all(text in problems for text in said)
    assert geomocap("info", run, check=False).returncode == 1
    status, told = run_tiny(tiny, run)
    notes = [line for line in told.splitlines() if line.startswith("note: ")]
    assert status == 0 and len(notes) == 4
    assert [text for note in notes for text in said if text in note] == [said[1], said[0], *said[2:]]
    found = digests(run)
    assert found.pop("voxels/letter.txt") and found == digests(whole)
    assert describe(run).problems == describe(whole).problems
    assert "note:" not in run_tiny(tiny, run)[1]


def test_no_room_at_any_stage_then_room(whole, tiny, tmp_path):
    run, stopped = tmp_path / "run", set[str]()
    sizes = sorted({p.stat().st_size for p in whole.rglob("*") if p.is_file()} - {0})
    complete = content(whole)
    named = ["run.toml", "voxels/000000.ply", "tracks.npz", "motion.glb"]
    for size in sorted({*sizes[::4], *((whole / name).stat().st_size for name in named)}):
        with no_file_beyond(size - 1):
            status, told = run_tiny(tiny, run)
        if status == 0:
            break
        (line,) = [line for line in told.splitlines() if line.startswith("geomocap: ")]
        assert "can't be written (File too large)" in line
        stopped.add(line.split(": ")[1].removeprefix(f"{run}/").split("/")[0])
        there = {n: data for n, data in content(run).items() if n in complete and n in digests(run)}
        assert all(data == complete[n] for n, data in there.items()), "half a file"
        assert not list(run.rglob(".geomocap-*"))
    assert {name.split("/")[0] for name in named} <= stopped
    status, told = run_tiny(tiny, run)
    assert status == 0, told
    assert digests(run) == digests(whole)


def test_the_second_is_refused_while_the_first_works(run, whole, tiny, geomocap):
    with working_in(Run(run), "run"):
        status, told = run_tiny(tiny, run)
        assert status == 1 and "in use by another process (`geomocap run`, process" in told
        for command in ("review", "export"):
            assert "in use by another process" in geomocap(command, run, check=False).stderr
    assert digests(run) == digests(whole)


@pytest.mark.parametrize("inside", ["images", "images/cam01", "sparse", "masks/new", "bar"])
def test_a_run_inside_what_it_reads_is_refused(tiny, inside):
    before = content(tiny)
    status, told = run_tiny(tiny, tiny / inside)
    assert status == 1 and "which is part of the input; choose another folder" in told
    assert content(tiny) == before


def test_export_by_command_is_taken_as_the_run_s_own(run, tiny, geomocap):
    geomocap("export", run, "--bvh", "--bvh-unit", "cm")
    written = (run / "motion.bvh").read_bytes()
    assert "note:" not in run_tiny(tiny, run)[1]
    assert (run / "motion.bvh").read_bytes() == written


@pytest.mark.parametrize("fraction", [0.05, 0.25, 0.5, 0.75, 0.95])
def test_a_disk_that_becomes_full_and_then_has_room(whole, tiny, tmp_path, fraction):
    kilobytes = sum(-(-p.stat().st_size // 4096) * 4 for p in whole.rglob("*") if p.is_file())
    with small_disk(tmp_path / "disk", int(fraction * kilobytes)) as disk:
        status, told = run_tiny(tiny, disk / "run")
        lines = [line for line in told.splitlines() if line.startswith("geomocap: ")]
        assert status == 1 and len(lines) == 1 and "can't be written (No space left on device)" in lines[0]
        make_larger(disk, 30_000)
        assert run_tiny(tiny, disk / "run")[0] == 0
        assert digests(disk / "run") == digests(whole)


def test_killed_at_random_moments(whole, tiny, tmp_path):
    chance, context = random.Random(1), killed.prepared()
    for k in range(3):
        _, wrong = killed.judge(context, digests(whole), tiny, tmp_path / str(k), chance.uniform(0, 4))
        assert not wrong


def test_many_runs_in_one_process_hold_no_more(tmp_path):
    held = list(soak.soak(10, tmp_path))
    assert len({(h.files, h.threads) for h in held[4:]}) == 1
    more = np.diff([h.memory for h in held[4:]])
    assert np.median(more) < 0.1  # MB; of no run's images or clouds may anything stay; 0.012 measured, 0.31 if 0.3 do


@pytest.mark.parametrize("wish", ["SIGTERM", "SIGINT"])
@pytest.mark.parametrize("lost", [False, True])
def test_a_process_that_is_asked_to_stop_says_one_line(wish, lost):
    code = f"""
import os, signal, sys, time
import geomocap.cli.info
from geomocap.cli import main

def work(*options):
    import geomocap.model.rig  # with COLMAP's library, which has a handler of its own
    try:
        os.kill(os.getpid(), signal.{wish})
        time.sleep(60)
    except KeyboardInterrupt:
        if {lost}:  # as modules that are just being imported
            raise ImportError("initialization failed")
        raise

geomocap.cli.info.foreign_calibration = work
sys.argv = ["geomocap", "info", "."]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 130
    assert done.stderr == "geomocap: interrupted; start it again to go on from what is finished\n"
