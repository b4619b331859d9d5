"""Observed points from tables, and a real board whose corners serve as the bar."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from data_tools.calibration_files import read_calibration
from geomocap.calibration.bar_calibration import calibrate_bar
from geomocap.calibration.observed_points import Observed, observations_of, read_observed
from geomocap.calibration.world import WorldKnowledge
from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig
from geomocap.model.triangulation import nearest_to_rays
from tests.geomocap.bar_scenes import three_cameras

SIZES = dict.fromkeys("abc", (640, 480))


def table_of_scene(path: Path) -> np.ndarray:
    scene = three_cameras(1, 20)
    pixels = scene.points(np.random.default_rng(0), 0.05)
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["frame", "camera", "point", "x", "y", "sigma"])
        for c, t, e in np.ndindex(*pixels.shape[:3]):
            if np.isfinite(pixels[c, t, e, 0]):
                out.writerow([t + 100, "abc"[c], ["left", "right"][e], *pixels[c, t, e], 0.05])
    return pixels


def test_our_table(tmp_path: Path) -> None:
    pixels = table_of_scene(tmp_path / "points.csv")
    observations = observations_of(read_observed(tmp_path / "points.csv"), sizes=SIZES)
    np.testing.assert_array_equal(observations.frames, np.arange(100, 120))
    np.testing.assert_allclose(observations.pixels, pixels)
    assert set(np.unique(observations.sigmas[np.isfinite(observations.sigmas)])) == {0.05}
    np.testing.assert_array_equal(observations_of(read_observed(tmp_path / "points.csv")).sizes, [[640, 480]] * 3)


def test_tables_that_cannot_be_used(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    for text, words in (
        ("a,b\n1,2\n", "columns a, b"),
        ("frame,camera,point,x,y\n", "no observations"),
        ("frame,camera,point,x,y\n0,a,p,1,oops\n", "line 2"),
        ("frame,camera,point,x,y\n0,a,p,1,nan\n", "must be numbers"),
        ("frame,camera,point,x,y\n0,a\n", "line 2"),
    ):
        file.write_text(text)
        with pytest.raises(CalibrationError, match=words):
            read_observed(file)
    with pytest.raises(CalibrationError, match="no readable CSV"):
        read_observed(tmp_path / "none.csv")
    table_of_scene(file)
    observed = read_observed(file)
    with pytest.raises(CalibrationError, match="no point nose"):
        observations_of(observed, [("left", "nose")])
    with pytest.raises(CalibrationError, match="outside its image of 320×240"):
        observations_of(observed, sizes=dict.fromkeys("abc", (320, 240)))
    with pytest.raises(CalibrationError, match="camera d"):
        observations_of(observed, cameras=("a", "d"))


def corners(observed: Observed, rig: Rig) -> dict[tuple[int, str], np.ndarray]:
    """Forward intersection of all corners seen by two cameras."""
    rows: dict[tuple[int, str], list[int]] = {}
    for k, key in enumerate(zip(observed.frames.tolist(), observed.points.tolist(), strict=True)):
        rows.setdefault(key, []).append(k)
    out = {}
    for key, own in rows.items():
        if len(own) >= 2:
            rays = [rig.rays(rig.names.index(observed.cameras[k]), observed.pixels[k][None]) for k in own]
            origins, directions = np.array([r[0] for r in rays]), np.array([r[1][0] for r in rays])
            out[key] = nearest_to_rays(origins[:, None], directions[:, None])[0]
    return out


def edge_errors(observed: Observed, rig: Rig, board: dict[str, np.ndarray], without: set[str]) -> np.ndarray:
    """Errors of the 54 mm edges between corners that are no bar ends, metres."""
    X = corners(observed, rig)
    errors = []
    for (t, a), x in X.items():
        for b in board:
            if a < b and not {a, b} & without and (t, b) in X and np.linalg.norm(board[a] - board[b]) < 0.055:
                errors.append(np.linalg.norm(x - X[t, b]) - 0.054)
    return np.array(errors)


def test_real_board_from_two_far_corners(data: Path) -> None:
    folder = data / "captures" / "caliscope_charuco"
    file = folder / "calibration" / "extrinsic" / "CHARUCO" / "xy_CHARUCO.csv"
    observed = read_observed(file)
    with file.open() as rows:
        board = {
            r["keypoint_id"]: np.array([float(r["obj_loc_x"]), float(r["obj_loc_y"])]) for r in csv.DictReader(rows)
        }
    diagonals = [("0", "11"), ("2", "9")]
    length = float(np.linalg.norm(board["0"] - board["11"]))
    assert length == pytest.approx(0.1947, abs=1e-5)
    supplied = read_calibration(folder / "config.toml")
    sizes = {n: (1280, 720) for n in supplied.names}
    observations = observations_of(observed, diagonals, sizes)

    ours = calibrate_bar(observations, length, world=WorldKnowledge(rig=supplied), length_sigma=1e-4)
    without = {name for pair in diagonals for name in pair}
    mine, theirs = (edge_errors(observed, rig, board, without) for rig in (ours.rig, supplied))
    assert len(mine) == len(theirs) > 450
    # Image sizes and one distance against a calibration by all corners with lenses calibrated beforehand
    assert np.sqrt(np.mean(mine**2)) < min(0.82e-3, np.sqrt(np.mean(theirs**2)))
    # Where principal points are not well determined, cameras may turn with them
    centers, angles = differences(ours.rig, supplied)
    assert centers.max() < 0.05 and angles.max() < 6

    kept = calibrate_bar(observations, length, world=WorldKnowledge(rig=supplied), given=supplied, length_sigma=1e-4)
    mine = edge_errors(observed, kept.rig, board, without)
    assert np.sqrt(np.mean(mine**2)) < np.sqrt(np.mean(theirs**2))
    centers, angles = differences(kept.rig, supplied)
    assert centers.max() < 0.005 and angles.max() < 0.6


def differences(one: Rig, other: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the cameras' centres (m) and angles between the cameras (degrees)."""
    turn = one.cam_from_world[:, :, :3] @ np.swapaxes(other.cam_from_world[:, :, :3], 1, 2)
    cosine = (np.trace(turn, axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(one.centers - other.centers, axis=1), np.degrees(np.arccos(np.clip(cosine, -1, 1)))
