"""Node tracking on bodies with known motion: a bending arm and two limbs that touch."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.nodes.coarse_motion import NEAR, CoarseTarget, State, mend
from geomocap.nodes.correspondences import Target
from geomocap.nodes.extremities import extremities, match_ends
from geomocap.nodes.keyframes import most_open, openness
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_tracking import NodeModel, track_nodes
from geomocap.nodes.surface_points import PointSet, point_set, surface_graph
from tests.geomocap.capsules import SMALL, bend, capsule, small_graph


def test_normals_point_outwards():
    p = capsule(1500)
    s = point_set(p, 1500, 9)
    axis = np.clip(s.positions[:, :1], 0, 1) * [1.0, 0, 0]
    outwards = s.positions - axis
    assert ((outwards * s.normals).sum(axis=1) > 0).mean() > 0.995


def test_given_normals_are_taken_where_they_are_known():
    p = capsule(1500)
    right = point_set(p, 1000, 9)
    given = np.random.default_rng(1).normal(size=p.shape)
    given /= np.linalg.norm(given, axis=1, keepdims=True)
    given[::2] = 0
    s = point_set(p, 1000, 9, normals=given)
    own = given[cKDTree(p).query(s.positions)[1]]
    known = own.any(axis=1)
    np.testing.assert_array_equal(s.normals[known], own[known])
    across = np.abs((s.normals * right.normals).sum(axis=1))[~known]
    np.testing.assert_allclose(across, 1, atol=1e-9)


def test_feature_gradients_of_a_linear_field():
    p = capsule(2000)
    field = np.column_stack([2 * p[:, 0], p @ [1.0, -1, 0.5]])
    s = point_set(p, 2000, 12, features=field)
    for f, g in enumerate(([2.0, 0, 0], [1.0, -1, 0.5])):
        along = g - (s.normals @ g)[:, None] * s.normals
        assert np.median(np.linalg.norm(s.gradients[:, f] - along, axis=1)) < 0.1 * np.linalg.norm(g)


def test_too_few_points_say_so():
    with pytest.raises(GeometryError, match="more than 9 are needed"):
        point_set(np.zeros((5, 3)), 100, 9)
    with pytest.raises(GeometryError, match="frame 1: a surface of 5 distinct points"):
        track_nodes(lambda t: capsule(900)[: (900, 5)[t]], 2, SMALL)


def test_samples_ride_rigidly():
    _, _, g = small_graph()
    R = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    t = np.array([0.3, 2.0, -1.0])
    y, n = g.deform(g.nodes @ R.T + t, np.tile(R, (len(g.nodes), 1, 1)))
    np.testing.assert_allclose(y, g.samples @ R.T + t, atol=1e-12)
    np.testing.assert_allclose(n, g.normals @ R.T, atol=1e-12)
    np.testing.assert_allclose(g.strain(g.nodes @ R.T + t, np.tile(R, (len(g.nodes), 1, 1))), 0, atol=1e-12)


def test_ends_of_a_capsule():
    p = capsule(1500)
    s = point_set(p, 1500, 9)
    ends = s.positions[extremities(surface_graph(s.positions, s.normals, 8), 0.2)]
    assert len(ends) == 2
    np.testing.assert_allclose(np.sort(ends[:, 0]), [-0.08, 1.08], atol=0.04)


def test_ends_are_matched_within_reach():
    expected = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    seen = np.array([[0.9, 0, 0], [0.1, 0, 0]])
    i, j = match_ends(expected, seen, 0.5)
    assert dict(zip(i.tolist(), j.tolist(), strict=True)) == {0: 1, 1: 0}
    assert len(match_ends(expected, np.zeros((0, 3)), 1.0)[0]) == 0


@pytest.fixture(scope="module")
def bending():
    """An arm that bends by 80° in 8 frames, sampled afresh in each."""
    angles = np.deg2rad(np.linspace(0, 80, 8))
    tracks = track_nodes(lambda t: bend(capsule(1500, seed=10 + t), angles[t]), 8, SMALL)
    return angles, tracks


def test_bending_arm(bending):
    angles, tracks = bending
    assert tracks.positions.shape == (150, 8, 3)
    # which point of the straight arm each node is: found in the reference frame, where its bend is known
    straight = unbend(tracks.reference, angles[tracks.reference_frame])
    truth = np.stack([bend(straight, a) for a in angles], axis=1)
    error = np.linalg.norm(tracks.positions - truth, axis=-1)
    # nodes are 4 cm apart; limbs slide by less than a quarter of that
    assert np.nanmedian(error) < 0.008
    assert np.nanpercentile(error, 95) < 0.025
    for part, turn in ((straight[:, 0] < 0.3, 0 * angles), (straight[:, 0] > 0.7, angles)):
        since = turn - turn[tracks.reference_frame]
        true = Rotation.from_rotvec(np.column_stack([0 * since, 0 * since, since])).as_matrix()
        difference = np.einsum("tji,ntjk->ntik", true, tracks.rotations[part])
        angle = np.arccos(np.clip((np.trace(difference, axis1=2, axis2=3) - 1) / 2, -1, 1))
        assert np.percentile(np.rad2deg(angle), 90) < 12


def test_openness_prefers_stretched_limbs():
    straight, folded = (point_set(bend(capsule(1200), a), 1200, 9) for a in (0.0, 2.8))
    open_, closed = (openness(surface_graph(s.positions, s.normals, 8)) for s in (straight, folded))
    assert closed < open_
    assert most_open([1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 1.0], list(range(7)), 7) == 4
    # near equals: the one next to the middle
    assert most_open([1.0] * 9, list(range(9)), 9) == 4


def test_normals_on_the_wrong_side_are_turned():
    s = point_set(capsule(1000), 1000, 9)
    wrong = replace(s, normals=-s.normals)
    np.testing.assert_array_equal(wrong.turned_like(s.positions, s.normals, 0.05).normals, s.normals)
    np.testing.assert_array_equal(s.turned_like(s.positions, s.normals, 0.05).normals, s.normals)


def unbend(p: np.ndarray, angle: float) -> np.ndarray:
    """Undo `bend`, by search along the straight arm's coordinates."""
    dense = capsule(60000, seed=99)
    return dense[cKDTree(bend(dense, angle)).query(p)[1]]


def test_skin_of_a_limb_is_free_to_slide_along_it(bending):
    angles = bending[0]
    skin = SMALL.model_copy(update={"part_rounds": 0})  # a rigid part would be held by the limb's end
    tracks = track_nodes(lambda k: bend(capsule(1200, seed=10 + k), angles[k]), len(angles), skin)
    straight = unbend(tracks.reference, angles[tracks.reference_frame])
    middle = (straight[:, 0] > 0.15) & (straight[:, 0] < 0.35)
    covariance = np.nanmean(tracks.covariance[middle], axis=(0, 1))
    # that half of the arm does not move: its axis is x, and across it the surface is held
    assert covariance[0, 0] > 4 * max(covariance[1, 1], covariance[2, 2])


def test_motion_paths_of_nodes(bending):
    _, tracks = bending
    paths = tracks.motion_paths()
    assert paths.count == 150
    assert np.isfinite(tracks.sigma).all()


def test_the_same_again_with_other_threads(bending):
    angles, tracks = bending
    with ThreadPoolExecutor(1) as executor:
        again = track_nodes(
            lambda t: bend(capsule(1500, seed=10 + t), angles[t]), len(angles), SMALL, executor=executor
        )
    np.testing.assert_array_equal(again.positions, tracks.positions)
    np.testing.assert_array_equal(again.rotations, tracks.rotations)


def test_the_same_in_another_unit_and_elsewhere(bending):
    angles, tracks = bending

    def points(frame: int) -> np.ndarray:
        return 1024.0 * bend(capsule(1500, seed=10 + frame), angles[frame])

    there = track_nodes(points, len(angles), SMALL)
    np.testing.assert_array_equal(there.positions, 1024.0 * tracks.positions)
    np.testing.assert_array_equal(there.covariance, 1024.0**2 * tracks.covariance)
    away = track_nodes(lambda t: points(t) + 1024.0 * 4096.0, len(angles), SMALL)
    moved = away.positions / 1024.0 - 4096.0 - tracks.positions
    assert np.abs(moved).max() < 1e-6


@pytest.mark.parametrize("still", [1, 2, 5])
def test_motion_in_a_single_frame_of_a_few_is_seen(still):
    shift = np.array([0.1, 0.05, 0.0])
    tracks = track_nodes(lambda t: capsule(1500) + (t == still) * shift, still + 1, SMALL)
    moved = tracks.positions[:, still] - tracks.positions[:, 0]
    np.testing.assert_allclose(np.nanmedian(moved, axis=0), shift, atol=0.01)


def test_coincident_points_are_one():
    points = capsule(300)
    once, often = (point_set(np.tile(points, (n, 1)), 2000, 9) for n in (1, 12))
    np.testing.assert_array_equal(often.positions, once.positions)
    with pytest.raises(GeometryError, match="frame 0: a surface of 8 distinct points"):
        track_nodes(lambda t: np.tile(points[:8], (20, 1)), 2, SMALL)


def test_no_frames():
    with pytest.raises(GeometryError, match="without frames"):
        track_nodes(lambda t: np.zeros((0, 3)), 0)


def test_each_face_of_a_box_is_turned_by_itself():
    # two faces of a long box with their normals inwards, the others outwards
    rng = np.random.default_rng(3)
    p = rng.uniform(-1, 1, (3000, 3)) * [0.5, 0.1, 0.1]
    axis = rng.integers(1, 3, 3000)
    side = rng.choice([-1.0, 1.0], 3000)
    p[np.arange(3000), axis] = 0.1 * side
    outward = np.zeros((3000, 3))
    outward[np.arange(3000), axis] = side
    given = np.where((side > 0)[:, None], -outward, outward)
    s = PointSet(p, given, np.zeros((3000, 0)), np.zeros((3000, 0, 3)))
    known = p[:300] + 0.02
    turned = s.turned_like(known, outward[:300], 0.08).normals
    assert ((turned * outward).sum(axis=1) > 0).mean() > 0.98


def four_legs(seed: int) -> np.ndarray:
    """Points of a table with thin legs, 4,000."""
    rng = np.random.default_rng(seed)
    top = ellipsoid_of([0.6, 0.3, 0.1], 3000, rng)
    leg = ellipsoid_of([0.04, 0.04, 0.3], 250, rng)
    return np.concatenate([top, *(leg + np.array([x, y, -0.35]) for x in (-0.4, 0.4) for y in (-0.1, 0.1))])


def ellipsoid_of(radii: list[float], count: int, rng: np.random.Generator) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    return radii * d / np.linalg.norm(d, axis=1, keepdims=True)


def test_a_limb_that_was_taken_for_another_is_found_again_from_where_it_jumps():
    settings = NodeTrackingSettings(nodes=300, coarse_nodes=150, points=2500, coarse_points=1500)
    sets = [point_set(four_legs(k), 2500, 9) for k in range(8)]
    model = NodeModel(sets[0], settings).coarse
    frames = [CoarseTarget(Target(s, np.zeros(0), settings.normal_weight), np.zeros((0, 3))) for s in sets]
    right = model.start()
    leg = (model.graph.nodes[:, 2] < -0.15) & (model.graph.nodes[:, 0] > 0.2) & (model.graph.nodes[:, 1] > 0)
    wrong = State(right.x - 0.2 * leg[:, None] * [0.0, 1.0, 0.0], right.R)
    states = [model.fit(f, wrong if 2 <= k < 6 else right, NEAR[-1:], False) for k, f in enumerate(frames)]
    assert all(np.abs(states[k].x[leg] - right.x[leg])[:, 1].mean() > 0.1 for k in range(2, 6))
    # so little of the surface is unexplained that the frames seem to fit
    assert states[3].cost < 1.3 * states[7].cost
    states = mend(model, frames, states, 0)
    for state in states:
        assert np.median(np.linalg.norm(state.x - right.x, axis=1)[leg]) < 0.5 * model.graph.spacing
