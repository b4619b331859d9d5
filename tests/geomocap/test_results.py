"""Files of a run: what is written comes back; what others wrote, or an older version, is read or refused clearly."""

from dataclasses import replace

import numpy as np
import pytest

from geomocap.errors import GeometryError, RunError
from geomocap.files.results import (
    read_diagnostics,
    read_ellipsoids,
    read_followed,
    read_keypoint_paths,
    read_skeleton,
    read_tracks,
    read_trajectories,
    read_warnings,
    write_diagnostics,
    write_ellipsoids,
    write_keypoint_paths,
    write_skeleton,
    write_tracks,
    write_warnings,
)
from geomocap.files.run import Run
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.model.hierarchy import parents_first
from geomocap.model.keypoint_paths import KeyPointPaths, KeyPoints
from geomocap.model.trajectories import Tracks, Trajectories
from geomocap.trajectories.smoothing import smooth_motion
from tests.geomocap.articulated import alike, articulated_skeleton, skeleton_arrays


def some_tracks(seed=0) -> Tracks:
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(size=(5, 9, 3)), axis=1)
    positions[0, :3] = positions[1, 6:] = positions[2, 4] = np.nan
    sigma = np.where(np.isfinite(positions[..., 0]), 0.001, np.nan)
    ray = np.where(np.isfinite(positions), rng.normal(size=positions.shape), 0.0).astype(np.float32)
    trajectories = Trajectories.of_positions(positions, sigma=sigma, ray=ray, placed=np.full(5, 4))
    return Tracks(trajectories, smooth_motion(positions, 30.0, sigma), positions.astype(np.float32), np.arange(5))


def test_a_skeleton_comes_back(tmp_path):
    skeleton = replace(articulated_skeleton(), offsets=np.ones((6, 3)), body_offsets=np.ones((7, 3)), fixed_joints=True)
    write_skeleton(Run(tmp_path), skeleton)
    alike(read_skeleton(Run(tmp_path)), skeleton)
    stored = Run(tmp_path).read_npz("skeleton.npz")
    np.testing.assert_array_equal(stored["root_positions"], skeleton.root_positions)
    np.testing.assert_array_equal(stored["local_rotations"], skeleton.local_rotations)


def test_joints_of_a_skeleton_may_come_in_any_order(tmp_path):
    arrays = skeleton_arrays()
    shuffled = np.random.default_rng(1).permutation(6)
    for name in ("joint_bodies", "joint_names"):
        arrays[name] = arrays[name][shuffled]
    arrays["joint_positions"] = arrays["joint_positions"][:, shuffled]
    Run(tmp_path).write_npz("skeleton.npz", **arrays)
    found, given = read_skeleton(Run(tmp_path)), articulated_skeleton()
    for (parent, child), name, places in zip(
        found.joint_bodies.tolist(), found.joint_names, found.joint_positions.swapaxes(0, 1), strict=True
    ):
        j = given.joint_bodies.tolist().index([parent, child])
        assert name == given.joint_names[j]
        np.testing.assert_array_equal(places, given.joint_positions[:, j])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"joint_bodies": np.array([[0, 9]] * 6)}, "joint 0 joins bodies 0 and 9, but there are 7 bodies"),
        ({"joint_bodies": np.array([[2, 2]] * 6)}, "joint 0 joins body 2 with itself"),
        ({"joint_bodies": np.array([[0, 1]] * 6)}, "6 joints between 7 bodies make no tree"),
        ({"joint_positions": np.zeros((20, 5, 3))}, r"joint_positions has the shape \(20, 5, 3\), expected 20 × 6 × 3"),
        ({"body_rotations": np.zeros((0, 7, 3, 3))}, "body_positions has the shape"),
        ({"fps": np.array(0.0)}, "fps is 0, expected"),
    ],
)
def test_broken_skeletons_are_named_with_their_file(tmp_path, change, says):
    Run(tmp_path).write_npz("skeleton.npz", **{**skeleton_arrays(), **change})
    with pytest.raises(RunError, match=says) as error:
        read_skeleton(Run(tmp_path))
    assert "skeleton.npz" in str(error.value) and "run again" in str(error.value) and "\n" not in str(error.value)


def test_a_file_that_is_no_skeleton(tmp_path):
    with pytest.raises(RunError, match=r"skeleton\.npz: missing"):
        read_skeleton(Run(tmp_path))
    Run(tmp_path).write_npz("skeleton.npz", positions=np.zeros(3))
    with pytest.raises(RunError, match="has no array joint_positions, joint_bodies"):
        read_skeleton(Run(tmp_path))


def test_trees_are_told_from_other_joints():
    assert parents_first(np.array([[2, 0], [0, 1]]), 3)[0] == 2
    root, order = parents_first(np.array([[0, 1], [2, 0]]), 3)
    assert root == 2 and order.tolist() == [1, 0]
    for pairs, count in (([[0, 1], [2, 1]], 3), ([[0, 1]], 3), ([[0, 1], [1, 2], [2, 1]], 4)):
        with pytest.raises(GeometryError, match="make no tree"):
            parents_first(np.array(pairs), count)


def test_ellipsoids_come_back_and_may_lack_counts(tmp_path):
    turns, counts = np.tile(np.eye(3), (3, 2, 1, 1)), np.array([[4, 0]] * 3)
    shells = Ellipsoids(np.ones((3, 2, 3)), np.ones((3, 2, 3)), turns, counts, np.ones((3, 2)), np.array([0, 1]))
    write_ellipsoids(Run(tmp_path), shells)
    alike(read_ellipsoids(Run(tmp_path)), shells)
    assert np.isnan(read_ellipsoids(Run(tmp_path)).seen_centers[:, 1]).all()
    Run(tmp_path).write_npz("ellipsoids.npz", centers=shells.centers, radii=shells.radii, rotations=shells.rotations)
    found = read_ellipsoids(Run(tmp_path))
    assert found.bodies.tolist() == [-1, -1] and np.isnan(found.errors).all() and (found.counts == 1).all()
    Run(tmp_path).write_npz("ellipsoids.npz", centers=shells.centers, radii=np.ones(3), rotations=shells.rotations)
    with pytest.raises(RunError, match=r"ellipsoids\.npz: radii has the shape"):
        read_ellipsoids(Run(tmp_path))


def test_tracks_come_back(tmp_path):
    tracks = some_tracks()
    write_tracks(Run(tmp_path), tracks)
    alike(read_tracks(Run(tmp_path)), tracks)
    alike(read_trajectories(Run(tmp_path)), tracks.trajectories)
    stored = Run(tmp_path).read_npz("tracks.npz")
    assert stored["start"].tolist() == [3, 0, 0, 0, 0] and stored["end"].tolist() == [8, 5, 8, 8, 8]


def test_tracks_that_stand_one_after_the_other_are_the_same(tmp_path):
    tracks = some_tracks()
    write_tracks(Run(tmp_path / "dense"), tracks)
    stored = Run(tmp_path / "dense").read_npz("tracks.npz")
    inside = np.zeros((5, 9), bool)
    for n, (first, last) in enumerate(zip(stored["start"], stored["end"], strict=True)):
        inside[n, first : last + 1] = True
    by_frame = [k for k, v in stored.items() if v.shape[:2] == (5, 9) and k != "unfiltered"]
    assert {"positions", "sigma", "n_views", "ray", "velocities"} <= set(by_frame)
    ragged = {k: v[inside] if k in by_frame else v for k, v in stored.items()}
    ragged |= {
        "layout": np.array("ragged"),
        "first": np.append(0, np.cumsum(inside.sum(axis=1))),
        "n_frames": np.array(9),
    }
    Run(tmp_path / "ragged").write_npz("tracks.npz", **ragged)
    alike(read_tracks(Run(tmp_path / "ragged")), tracks)
    for broken in ({"start": ragged["start"] + 5}, {"first": ragged["first"][:-1]}, {"n_frames": np.array(4)}):
        Run(tmp_path / "broken").write_npz("tracks.npz", **{**ragged, **broken})
        with pytest.raises(RunError, match=r"tracks\.npz: .*geomocap track"):
            read_trajectories(Run(tmp_path / "broken"))
    del ragged["first"]
    Run(tmp_path / "broken").write_npz("tracks.npz", **ragged)
    with pytest.raises(RunError, match=r"tracks\.npz: has no array first"):
        read_tracks(Run(tmp_path / "broken"))


def test_tracks_of_older_versions_and_of_others(tmp_path):
    positions = some_tracks().trajectories.positions
    sight = np.ones(positions.shape)
    Run(tmp_path).write_npz("tracks.npz", positions=positions, sight=sight)
    found = read_trajectories(Run(tmp_path))
    np.testing.assert_array_equal(found.ray, sight)
    assert np.isnan(found.sigma).all() and found.n_views.max() == 1
    with pytest.raises(RunError, match=r"tracks\.npz: has no array velocities"):
        read_tracks(Run(tmp_path))
    Run(tmp_path).write_npz("tracks.npz", positions=positions[0])
    with pytest.raises(RunError, match=r"tracks\.npz: positions has the shape"):
        read_trajectories(Run(tmp_path))


def test_key_points_come_back_and_need_names_positions_and_radii_only(tmp_path):
    paths = KeyPointPaths(np.ones((4, 2, 3)), np.zeros((4, 2), bool), np.full((4, 2), 7), np.full((4, 2), 0.001))
    points = KeyPoints(("a", "b"), np.array([0.1, 0.2]), paths, np.array([[0, 1]]), np.ones((4, 2, 3)), None, 30.0)
    assert write_keypoint_paths(Run(tmp_path), points) == tmp_path / "keypoints.npz"
    alike(read_keypoint_paths(Run(tmp_path)), points)
    few = {"names": np.array(["a", "b"]), "positions": paths.positions, "radius": points.radius}
    Run(tmp_path).write_npz("keypoints.npz", **few)
    found = read_keypoint_paths(Run(tmp_path))
    assert not found.paths.bridged.any() and np.isnan(found.paths.std).all() and len(found.links) == 0
    Run(tmp_path).write_npz("keypoints.npz", **{**few, "links": np.array([[0, 5]])})
    with pytest.raises(RunError, match=r"keypoints\.npz: key-points: links name others"):
        read_keypoint_paths(Run(tmp_path))


def test_diagnostics_come_back_and_tell_what_was_followed(tmp_path):
    run = Run(tmp_path)
    assert read_diagnostics(run) == Diagnostics() and read_warnings(run) == []
    with pytest.raises(RunError, match="has no tracks"):
        read_followed(run)
    made = Diagnostics(paths="nodes", sample_positions=np.ones((3, 4, 3)), threshold=0.5, first_frame=2)
    write_diagnostics(run, made)
    alike(read_diagnostics(run), made)
    assert len(read_followed(run)) == 3
    write_warnings(run, ["dark"])
    assert read_warnings(run) == ["dark"]
    (tmp_path / "diagnostics.json").write_text("{")
    with pytest.raises(RunError, match=r"diagnostics\.json: damaged"):
        read_warnings(run)
