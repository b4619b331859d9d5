"""The door for writing: whole or not at all, whatever library writes; no room, killed processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from data_tools.calibration_files import write_colmap
from data_tools.video_writing import VideoFile
from geomocap.errors import RunError
from geomocap.export.bvh import write_bvh
from geomocap.export.c3d import write_c3d
from geomocap.export.glb import write_glb
from geomocap.export.markers import markers_from_run
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.tables import motion_table, write_csv, write_parquet
from geomocap.export.trc import write_trc
from geomocap.export.usd import write_usd
from geomocap.files.atomic import (
    by_library,
    copy_whole,
    remove_remains,
    temporary_beside,
    write_atomic,
    write_folder,
    write_text,
)
from geomocap.files.frame_files import write_points, write_voxels
from geomocap.files.images import write_image, write_mask
from geomocap.files.npz import write_npz
from geomocap.files.rigs import read_rig
from geomocap.files.stage_records import FOLDER, add_to_journal
from geomocap.model.frame_geometry import BodyPoints, Voxels
from tests.disks import no_file_beyond, small_disk
from tests.geomocap.articulated import skeleton_arrays, skeleton_of
from tests.geomocap.ball import ring
from viz.drawing import write_png
from viz.films import write_video

SOME = np.random.default_rng(0)
PICTURE = SOME.integers(0, 256, (96, 128, 3)).astype(np.uint8)
GRID = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.int32)
SKELETON = skeleton_of(skeleton_arrays())
MOTION, MARKERS = motion_from_skeleton(SKELETON), markers_from_run(SKELETON)
FILM = [np.roll(PICTURE, 5 * k, axis=1) for k in range(5)]


def write_by_pictures(path: Path) -> None:
    film = VideoFile(path, 128, 96, 10.0)
    try:
        for picture in FILM:
            film.add(picture)
        film.finish()
    finally:
        film.close()


def copy(path: Path) -> None:
    copy_whole(Path(sys.executable).resolve(), path)


WRITERS: dict[str, Callable[[Path], object]] = {
    "text.txt": partial(write_text, text="a line\n" * 2000),
    "arrays.npz": partial(write_npz, arrays={"a": SOME.random((30, 40)), "b": SOME.random((10, 40))}),
    "voxels.ply": partial(write_voxels, voxels=Voxels(GRID, np.uint8(GRID * 9), np.zeros(3), 0.01)),
    "points.ply": partial(write_points, points=BodyPoints(GRID * 0.1, np.arange(len(GRID)))),
    "image.png": partial(write_image, image=PICTURE),
    "image.jpg": partial(write_image, image=PICTURE),
    "mask.png": partial(write_mask, mask=PICTURE[..., 0]),
    "sheet.png": partial(write_png, image=PICTURE),
    "film.mp4": partial(write_video, frames=FILM, fps=10.0),
    "pictures.mp4": write_by_pictures,
    "motion.bvh": partial(write_bvh, motion=MOTION),
    "motion.trc": partial(write_trc, markers=MARKERS),
    "motion.c3d": partial(write_c3d, markers=MARKERS, motion=MOTION),
    "markers.c3d": partial(write_c3d, markers=MARKERS),
    "motion.glb": partial(write_glb, motion=MOTION),
    "motion.usdc": partial(write_usd, motion=MOTION),
    "motion.usda": partial(write_usd, motion=MOTION),
    "motion.csv": partial(write_csv, table=motion_table(MARKERS, MOTION)),
    "motion.parquet": partial(write_parquet, table=motion_table(MARKERS, MOTION)),
    "copy.bin": copy,
    "text_model": partial(write_colmap, ring(12, 40)),
    "binary_model": partial(write_colmap, ring(12, 40), binary=True),
}
NEEDS = {"c3d": "ezc3d", "usdc": "pxr", "usda": "pxr", "parquet": "pyarrow"}


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", WRITERS)
def test_no_room_leaves_what_was_there_and_says_why(tmp_path, name, capfd):
    pytest.importorskip(NEEDS.get(name.split(".")[-1], "numpy"))
    write, place = WRITERS[name], tmp_path / "place"
    write(place / name)
    whole = content(place)
    size = max(len(data) for data in whole.values())
    assert size > 100
    for room in (0, size // 3, size - 1):
        with no_file_beyond(room), pytest.raises(RunError, match=rf"{name}: can't be written \(File too large\)"):
            write(place / name)
        assert content(place) == whole, room
        with no_file_beyond(room), pytest.raises(RunError):
            write(tmp_path / "empty" / name)
        assert not list((tmp_path / "empty").rglob("*")), room
    write(tmp_path / "empty" / name)
    assert content(tmp_path / "empty") == whole
    assert capfd.readouterr() == ("", ""), "what libraries say of it stays with them"


def test_a_small_disk_says_that_it_is_full(tmp_path):
    with small_disk(tmp_path / "disk", 16) as disk:
        for name in ("voxels.ply", "mask.png", "text_model", "text.txt"):
            for number in range(9):  # until it is full, whatever is left in the end
                try:
                    WRITERS[name](disk / f"{number}{name}")
                except RunError as error:
                    assert "No space left on device" in str(error)
                    break
            else:
                pytest.fail("it has room for everything")
            assert not list(disk.glob(".*"))


def test_a_journal_that_got_no_line_is_not_left_behind(tmp_path):
    (tmp_path / FOLDER).mkdir()
    (tmp_path / "a.ply").write_bytes(b"x")
    with no_file_beyond(0), pytest.raises(RunError, match="free space"):
        add_to_journal(tmp_path, "voxels", [tmp_path / "a.ply"])
    assert not list((tmp_path / FOLDER).iterdir())
    add_to_journal(tmp_path, "voxels", [tmp_path / "a.ply"])
    with no_file_beyond(0), pytest.raises(RunError):
        add_to_journal(tmp_path, "voxels", [tmp_path / "a.ply"])
    assert (tmp_path / FOLDER / "voxels.journal").read_text().count("a.ply") == 1


def test_a_folder_is_swapped_as_a_whole_and_other_files_stay(tmp_path):
    sparse = tmp_path / "sparse"
    write_colmap(ring(3, 40), sparse, binary=True)
    write_text(sparse / "notes" / "mine.txt", "dear")
    write_text(sparse / "mine.txt", "dear")
    write_colmap(ring(5, 40), sparse)
    assert len(read_rig(sparse)) == 5
    assert not list(sparse.glob("*.bin")), "a model in another form would contradict"
    assert (sparse / "notes" / "mine.txt").read_text() == (sparse / "mine.txt").read_text() == "dear"
    assert [p.name for p in tmp_path.iterdir()] == ["sparse"]


def test_a_folder_that_was_away_when_the_process_was_killed_is_back(tmp_path):
    write_colmap(ring(3, 40), tmp_path / "sparse")
    (tmp_path / "sparse").rename(tmp_path / ".sparse.before")

    def fail(folder: Path) -> None:
        raise RunError("no")

    with pytest.raises(RunError, match="no"):
        write_folder(tmp_path / "sparse", fail)
    assert len(read_rig(tmp_path / "sparse")) == 3


def test_temporary_names_are_unique_and_go_when_their_process_has_ended(tmp_path):
    names = {temporary_beside(tmp_path / "motion.bvh") for _ in range(100)}
    assert len(names) == 100 and {n.suffix for n in names} == {".bvh"}
    mine = names.pop()
    code = (
        "from pathlib import Path; import os, signal, sys\n"
        "from geomocap.files.atomic import write_atomic\n"
        "def write(path): path.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)\n"
        "write_atomic(Path(sys.argv[1]), write)"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path / "x.txt")], env=os.environ)
    assert ended.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    for other in (mine, tmp_path / ".hidden.tmp.bvh", tmp_path / "motion.bvh"):
        other.write_text("")
    remove_remains([tmp_path])
    assert not left.exists() and mine.exists()
    remove_remains([tmp_path], alone=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hidden.tmp.bvh", "motion.bvh"]


def test_libraries_that_name_utf_8_only_write_into_any_folder(tmp_path):
    def library(path: Path) -> None:
        str(path).encode()
        path.write_text("whole")

    for name in ("plain", os.fsdecode(b"\xff")):
        (tmp_path / name).mkdir()
        write_atomic(tmp_path / name / "a.txt", by_library(library))
        assert [f.read_text() for f in (tmp_path / name).iterdir()] == ["whole"]
