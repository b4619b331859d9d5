"""What a run knows of its stages: which files are theirs and as they were written, and whose the others are."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from geomocap.errors import RunError
from geomocap.files.atomic import temporary_beside, write_text
from geomocap.files.run import Run
from geomocap.files.run_lock import working_in
from geomocap.files.stage_records import listed_faults

FRAMES = 5


@pytest.fixture
def run(tmp_path) -> Run:
    """A run with a finished stage of frames, and one of single files."""
    run = Run(tmp_path / "run")
    run.write_record({"source": {"kind": "scans"}})
    assert run.begin("voxels", "key", ["voxels"]) == {}
    for k in range(FRAMES):
        write_text(run.frame_file("voxels", k), f"frame {k} " * 20)
        run.note("voxels", [run.frame_file("voxels", k)])
    run.finish("voxels")
    run.begin("segmentation", "key", ["skeleton.npz"], ["model.npz"], ["motion.bvh", "review"])
    write_text(run.path / "skeleton.npz", "bones " * 20)
    write_text(run.path / "model.npz", "skin " * 20)
    run.finish("segmentation", ["model.npz"])
    run.begin("review", "key", ["review"])
    write_text(run.path / "review" / "report.html", "page " * 20)
    run.note("review", [run.path / "review" / "report.html"])
    run.finish("review")
    return run


def test_a_file_that_is_not_as_it_was_written_is_noticed(run):
    assert run.faults() == {} and run.is_done("voxels", "key") and run.is_done("segmentation", "key")
    run.frame_file("voxels", 0).unlink()
    file = run.frame_file("voxels", 1)
    file.write_bytes(file.read_bytes()[:30])
    file = run.frame_file("voxels", 2)
    file.write_bytes(file.read_bytes()[::-1])
    os.utime(file, ns=(0, 0))
    os.utime(run.frame_file("voxels", 3), ns=(0, 0))  # copied elsewhere, with its content
    faults = {
        "voxels/000000.ply": "missing",
        "voxels/000001.ply": "cut (30 of 160 bytes)",
        "voxels/000002.ply": "replaced by another",
    }
    assert run.faults() == faults and not run.is_done("voxels", "key") and run.is_done("segmentation", "key")
    assert run.begin("voxels", "key", ["voxels"]) == faults
    assert run.sound("voxels") == {run.frame_file("voxels", k) for k in (3, 4)}
    assert run.unfinished() == ["voxels"]
    said = listed_faults(faults, 1)
    assert said == "voxels/000000.ply is missing, and 2 other files are not as they were written"


def test_optional_files_count_too(run):
    (run.path / "model.npz").unlink()
    assert run.begin("segmentation", "key", ["skeleton.npz"], ["model.npz"]) == {"model.npz": "missing"}


def test_a_killed_stage_goes_on_from_what_it_noted(run):
    run.begin("voxels", "other key", ["voxels"])
    assert run.frames("voxels") == []
    for k in range(3):
        write_text(run.frame_file("voxels", k), "whole")
        run.note("voxels", [run.frame_file("voxels", k)])
    write_text(run.frame_file("voxels", 3), "not noted")
    with (run.path / ".stages" / "voxels.journal").open("a") as journal:
        journal.write('\n["voxels/0000')  # killed while it wrote a line
    assert run.begin("voxels", "other key", ["voxels"]) == {}
    assert run.sound("voxels") == {run.frame_file("voxels", k) for k in range(3)}
    write_text(run.frame_file("voxels", 3), "whole")
    run.note("voxels", [run.frame_file("voxels", 3)])
    run.finish("voxels")
    assert run.is_done("voxels", "other key") and len(run.sound("voxels")) == 4


def test_files_of_others_stay(run):
    others = [
        "voxels/letter.txt",
        "voxels/mine.ply",
        "voxels/000001.txt",
        "review/notes.md",
        "silhouettes/a/b.txt",
        "x.npz",
    ]
    for name in others:
        write_text(run.path / name, "dear")
    run.begin("voxels", "new", ["voxels"], derived=["review", "silhouettes", "motion.bvh"])
    assert run.frames("voxels") == [] and not (run.path / "review" / "report.html").exists()
    assert all((run.path / name).read_text() == "dear" for name in others)
    assert "review" not in [f.stem for f in (run.path / ".stages").glob("*.json")], "nothing is left to be missed"


@pytest.mark.parametrize("name", ["voxels/000000.ply", "silhouettes/left/000007.png", "motion.bvh", "model.npz"])
def test_results_in_a_folder_that_is_no_run_are_not_ours(tmp_path, name):
    write_text(tmp_path / name, "somebody's")
    with pytest.raises(RunError, match=f"{name}: is there, but not of a run"):
        Run(tmp_path).claim()
    assert (tmp_path / name).read_text() == "somebody's"


@pytest.mark.parametrize(
    "name", ["../precious.txt", "/{}/precious.txt", "voxels/../../precious.txt", "out/precious.txt"]
)
def test_a_record_of_somebody_else_deletes_nothing_outside(run, tmp_path, name):
    precious = tmp_path / "precious.txt"
    precious.write_text("dear")
    (run.path / "out").symlink_to(tmp_path)
    file = run.path / ".stages" / "voxels.json"
    record = json.loads(file.read_text())
    record["files"][name.format(tmp_path)] = [4, 0, 0]
    file.write_text(json.dumps(record))
    run.begin("voxels", "new", ["voxels"])
    assert precious.read_text() == "dear"


@pytest.mark.parametrize("link", ["voxels", "silhouettes/cam1"])
def test_a_run_writes_through_no_link(run, tmp_path, link):
    (tmp_path / "elsewhere").mkdir()
    place = run.path / link
    if place.is_dir():
        place.rename(tmp_path / "away")
    place.parent.mkdir(exist_ok=True)
    place.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunError, match=f"{link}: is a link"):
        run.begin("x", "key", [link.split("/")[0]])


@pytest.mark.parametrize("text", ["", "[1, 2]", '{"key": 1}', '{"key": "key", "done": true, "outputs": 3}', "[" * 9999])
def test_a_record_that_can_not_be_read_is_none(run, text):
    (run.path / ".stages" / "voxels.json").write_text(text)
    assert not run.is_done("voxels", "key")
    assert run.begin("voxels", "key", ["voxels"]) == {} and run.frames("voxels") == []


# --- one at a time ---


def test_the_second_is_told_who_works_in_a_run(run):
    left = temporary_beside(run.frame_file("voxels", 0))
    left.write_text("half")
    who = rf"run: in use by another process \(`geomocap track`, process {os.getpid()} of .*, since 20.*\).*--wait"
    with working_in(run, "track"):
        assert not left.exists(), "what a killed process left goes"
        with pytest.raises(RunError, match=who), working_in(run, "run"):
            pytest.fail("two work in it")
    with working_in(run):
        pass


def test_waiting_for_the_first(run):
    told: list[str] = []
    order: list[str] = []
    begun, waiting = threading.Event(), threading.Event()

    def first() -> None:
        with working_in(run, "run"):
            begun.set()
            waiting.wait(20)
            order.append("first")

    def tell(text: str) -> None:
        told.append(text)
        waiting.set()

    thread = threading.Thread(target=first)
    thread.start()
    assert begun.wait(20)
    with working_in(run, "export", wait=True, tell=tell):
        order.append("second")
    thread.join()
    assert order == ["first", "second"]
    assert told[0].startswith("waiting for another process (`geomocap run`, process")


def test_the_lock_goes_with_its_process(run):
    code = (
        "import os, signal, sys; from pathlib import Path\n"
        "from geomocap.files.run import Run; from geomocap.files.run_lock import working_in\n"
        "with working_in(Run(Path(sys.argv[1])), 'run'): os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(run.path)]).returncode == -signal.SIGKILL
    with working_in(run):
        pass


def test_where_nothing_was_written_nothing_is_left(tmp_path):
    with pytest.raises(RunError, match="no capture"), working_in(Run(tmp_path / "run")):
        raise RunError("no capture")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["x" * 300, "file/run"])
def test_a_folder_that_can_not_be_made_is_named(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match=f"{name}: can't be written"), working_in(Run(Path(tmp_path / name))):
        pytest.fail("it was made")
