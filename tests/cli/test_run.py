"""The main job from the command line: what it leaves, that it repeats, and that it goes on after being killed."""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from data_tools.calibration_files import read_calibration
from geomocap.files.frame_files import read_points, read_voxels
from tests.cli.conftest import CAMERAS, FRAMES, QUICK, SETTINGS

CHANGING = {"timings.json", "run.toml"}


def digests(run: Path) -> dict[str, str]:
    """Digest of every result file; the records of when and how long are left out."""
    return {
        str(p.relative_to(run)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(run.rglob("*"))
        if p.is_file() and p.name not in CHANGING and ".stages" not in p.parts
    }


@pytest.fixture(scope="session")
def finished(small_capture, geomocap, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    geomocap("run", small_capture, run, *QUICK, "--no-pictures")
    return run


def test_a_run_holds_what_the_contract_says(finished):
    assert len(list(finished.glob("silhouettes/*/*.png"))) == CAMERAS * FRAMES
    for k in range(FRAMES):
        voxels = read_voxels(finished / f"voxels/{k:06d}.ply")
        bodies = read_points(finished / f"bodies/{k:06d}.ply")
        assert len(voxels.indices) == len(bodies.positions) > 500
        np.testing.assert_allclose(bodies.positions, voxels.points, atol=1e-6)
        assert len(np.unique(voxels.colors, axis=0)) > 10
    ellipsoids = dict(np.load(finished / "ellipsoids.npz"))
    skeleton = dict(np.load(finished / "skeleton.npz"))
    T, K = ellipsoids["centers"].shape[:2]
    assert T == FRAMES and ellipsoids["body"].shape == (K,)
    B = skeleton["body_rotations"].shape[1]
    assert skeleton["joint_positions"].shape == (FRAMES, B - 1, 3)
    np.testing.assert_allclose(skeleton["body_rotations"][0], np.broadcast_to(np.eye(3), (B, 3, 3)), atol=1e-9)
    for name in ("motion.bvh", "motion.trc", "motion.glb"):
        assert (finished / name).stat().st_size > 100
    record = tomllib.loads((finished / "run.toml").read_text())
    assert record["config"]["carving"]["resolution"] == 64 and record["source"]["kind"] == "capture"
    timings = json.loads((finished / "timings.json").read_text())
    assert timings["silhouettes"]["items"] == CAMERAS * FRAMES and timings["voxels"]["items"] == FRAMES
    assert not [p for p in finished.rglob("*") if ".tmp" in p.name]


def test_results_repeat_bit_for_bit_with_any_number_of_workers(finished, small_capture, geomocap, tmp_path):
    again = tmp_path / "again"
    geomocap("run", small_capture, again, "--config", finished / "run.toml", "--workers", 3, "--no-pictures")
    assert digests(again) == digests(finished)


def test_nothing_is_done_twice(finished, small_capture, geomocap):
    before = {p: p.stat().st_mtime_ns for p in finished.rglob("*.ply")}
    geomocap("run", small_capture, finished, *QUICK, "--no-pictures")
    assert {p: p.stat().st_mtime_ns for p in finished.rglob("*.ply")} == before


def test_a_run_killed_again_and_again_goes_on_and_ends_with_the_same_files(finished, small_capture, geomocap, tmp_path):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "geomocap", "run", str(small_capture), str(run), *QUICK, "--no-pictures"]
    for stop_after in ("silhouettes/*/*.png", "voxels/*.ply", "bodies/*.ply"):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        while process.poll() is None and len(list(run.glob(stop_after))) < 2:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    geomocap("run", small_capture, run, *QUICK, "--no-pictures")
    assert digests(run) == digests(finished)


def test_changed_setting_does_again_only_what_depends_on_it(small_capture, geomocap, tmp_path):
    run = tmp_path / "run"
    geomocap("voxels", small_capture, run, *SETTINGS)
    masks = {p: p.stat().st_mtime_ns for p in run.rglob("*.png")}
    first = digests(run)
    geomocap("voxels", small_capture, run, "--carving.resolution", 48)
    assert {p: p.stat().st_mtime_ns for p in run.rglob("*.png")} == masks
    assert digests(run)["voxels/000000.ply"] != first["voxels/000000.ply"]


def test_stage_commands_record_what_each_was_done_with(small_capture, geomocap, tmp_path):
    run = tmp_path / "run"
    geomocap("voxels", small_capture, run, *SETTINGS)
    geomocap("silhouettes", small_capture, run, "--silhouettes.samples", 5)
    settings = tomllib.loads((run / "run.toml").read_text())["config"]
    assert settings["carving"]["resolution"] == 64 and settings["silhouettes"]["samples"] == 5


def test_given_masks_are_used_as_they_are(capture, small_capture, geomocap, tmp_path):
    truth = small_capture.parent / "truth" / "masks"
    shutil.copytree(truth, capture / "masks")
    geomocap("silhouettes", capture, tmp_path / "run")
    for file in truth.rglob("*.png"):
        import cv2

        made = cv2.imread(str(tmp_path / "run/silhouettes" / file.relative_to(truth)), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(made, cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))


def test_scans_are_segmented_like_voxels(finished, small_capture, geomocap, tmp_path):
    m3 = ["--segmentation.method", "m3", "--no-pictures"]
    geomocap("run", small_capture, tmp_path / "voxels", *QUICK, *m3)
    geomocap("segment", finished / "voxels", tmp_path / "scans", "--fps", 10, *m3)
    ours, other = np.load(tmp_path / "scans/ellipsoids.npz"), np.load(tmp_path / "voxels/ellipsoids.npz")
    np.testing.assert_allclose(ours["centers"], other["centers"], atol=1e-9)
    np.testing.assert_array_equal(ours["body"], other["body"])


def test_patches_carry_the_ellipsoids_of_m3(finished, small_capture, geomocap, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    m3 = ["--method", "m3", "--no-pictures"]
    geomocap("run", small_capture, run, *QUICK, *m3, "--paths", "patches")
    carried = np.load(run / "skeleton.npz")["body_rotations"]
    geomocap("run", small_capture, run, *QUICK, *m3)
    alone = np.load(run / "skeleton.npz")["body_rotations"]
    assert (run / "tracks.npz").exists()
    assert carried.shape != alone.shape or not np.allclose(carried, alone)


def test_m3_names_what_is_missing_to_carry_it(finished, geomocap, tmp_path):
    m3 = ["--method", "m3", "--fps", 10, "--no-pictures"]
    result = geomocap("segment", finished / "voxels", tmp_path / "run", *m3, "--paths", "patches", check=False)
    assert "no surface patches could be followed in the images; set segmentation.paths = auto" in result.stderr
    result = geomocap("segment", finished / "voxels", tmp_path / "run", *m3, "--paths", "points", check=False)
    assert result.returncode and "segmentation.paths" in result.stderr
    result = geomocap(
        "segment",
        finished / "voxels",
        tmp_path,
        *m3,
        "--paths",
        "points",
        "--segmentation.iterative",
        "true",
        check=False,
    )
    assert "segmentation.iterative takes volumes apart" in result.stderr


def test_scans_without_colours_or_cameras_get_bodies_by_motion(finished, geomocap, tmp_path):
    geomocap("segment", finished / "voxels", tmp_path / "run", "--fps", 10, "--no-pictures")
    skeleton = np.load(tmp_path / "run/skeleton.npz")
    assert len(skeleton["joint_names"]) >= 2
    labels = read_points(tmp_path / "run/bodies/000003.ply").body
    assert len(np.unique(labels)) == skeleton["body_rotations"].shape[1]


def test_single_scan_gets_its_ellipsoids(finished, geomocap, tmp_path):
    geomocap("segment", finished / "voxels/000000.ply", tmp_path / "run", "--no-pictures")
    ellipsoids = np.load(tmp_path / "run/ellipsoids.npz")
    assert ellipsoids["centers"].shape[0] == 1 and ellipsoids["centers"].shape[1] >= 4
    assert not (tmp_path / "run/skeleton.npz").exists()


def test_a_file_holds_the_options_of_a_command_without_settings(small_capture, geomocap, tmp_path):
    settings = tmp_path / "options.toml"
    settings.write_text('format = "opencv"\nmetres-per-unit = 2.0\nworkers = 1\n')
    geomocap("convert-calibration", small_capture / "sparse", tmp_path / "scaled", "--config", settings)
    given, scaled = (read_calibration(p) for p in (small_capture / "sparse", tmp_path / "scaled"))
    ratio = np.linalg.norm(scaled.centers, axis=1) / np.linalg.norm(given.centers, axis=1)
    np.testing.assert_allclose(ratio, 2.0, rtol=1e-6)
    settings.write_text("metres = 1.0\n")
    refused = geomocap("convert-calibration", small_capture, tmp_path / "b", "--config", settings, check=False)
    assert "unknown setting metres; expected format, metres-per-unit, workers" in refused.stderr
