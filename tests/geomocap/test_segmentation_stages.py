"""Split, merge and match against slow references, and what must hold for any input."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.model.ellipsoids import fit_ellipsoids
from geomocap.segmentation.ellipsoid_assignment import assign_tree
from geomocap.segmentation.ellipsoid_matching import first_frame, match_frame, match_frames
from geomocap.segmentation.ellipsoid_merging import merge_frame
from geomocap.segmentation.ellipsoid_splitting import SplitFrame, split_frame
from geomocap.segmentation.m3_settings import SegmentationSettings
from tests.geomocap.segmentation_scenes import capsule

SPACING = 0.01
SMALL = SegmentationSettings(max_depth=4)


def figure(seed: int = 0, count: int = 1500) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [
            capsule(rng, 2 * count, [0, 0, 0], [0, 0, 0.5], 0.15),
            capsule(rng, count, [0.2, 0, 0.5], [0.6, 0.1, 0.6], 0.05),
            capsule(rng, count, [-0.2, 0, 0.5], [-0.6, 0, 0.4], 0.05),
        ]
    )


def leaf_labels(split: SplitFrame) -> np.ndarray:
    labels = np.empty(len(split.points), int)
    labels[split.order] = split.leaves
    return labels


def split_reference(points: np.ndarray, spacing: float, settings: SegmentationSettings) -> list[np.ndarray]:
    """Leaves as index arrays, by the paper's steps."""

    def divide(members: np.ndarray, depth: int) -> list[np.ndarray]:
        fit = fit_ellipsoids(points[members], np.zeros(len(members), int), 1, spacing)
        if fit.errors[0] <= settings.split_error * spacing or depth == settings.max_depth:
            return [members]
        below = (points[members] - fit.centers[0]) @ fit.rotations[0][:, 0] < 0
        if min(below.sum(), (~below).sum()) < settings.min_points:
            return [members]
        return divide(members[below], depth + 1) + divide(members[~below], depth + 1)

    return divide(np.arange(len(points)), 0)


@pytest.mark.parametrize("split_error", [0.05, 1.0, 3.0])
def test_split_agrees_with_recursion(split_error):
    points = figure()
    chosen = SegmentationSettings(max_depth=5, split_error=split_error)
    split = split_frame(points, SPACING, chosen)
    expected = split_reference(points, SPACING, chosen)
    labels = leaf_labels(split)
    assert len(split.errors) == len(expected) > 1
    for k, members in enumerate(expected):
        np.testing.assert_array_equal(np.flatnonzero(labels == k), members)
    fit = fit_ellipsoids(points, labels, len(expected), SPACING)
    np.testing.assert_allclose(split.ellipsoids.errors, fit.errors, rtol=1e-6)
    np.testing.assert_allclose(split.ellipsoids.radii, fit.radii, rtol=1e-6)


def test_one_ellipsoid_is_not_split():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(5000, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * [0.5, 0.3, 0.2]
    assert len(split_frame(points, SPACING, SegmentationSettings(split_error=2.0)).errors) == 1


@settings(max_examples=15, deadline=None)
@given(turn=st.tuples(*[st.floats(-3, 3)] * 3), scale=st.floats(0.01, 100), seed=st.integers(0, 100))
def test_split_does_not_depend_on_order_place_or_scale(turn, scale, seed):
    points = figure(count=400)
    shuffle = np.random.default_rng(seed).permutation(len(points))
    moved = scale * Rotation.from_rotvec(turn).apply(points) + [5.0, -3.0, 1.0]
    a = leaf_labels(split_frame(points, SPACING, SMALL))
    b = leaf_labels(split_frame(moved[shuffle], SPACING * scale, SMALL))
    pairs = np.unique(np.stack([a[shuffle], b], axis=1), axis=0)
    # the same sets, numbered otherwise; a point on a cutting plane may fall on either side
    sizes = np.array([((a[shuffle] == i) & (b == j)).sum() for i, j in pairs])
    assert np.sort(sizes)[::-1][: a.max() + 1].sum() >= len(points) - 3


def merge_reference(points: np.ndarray, labels: np.ndarray, spacing: float, limit: float) -> np.ndarray:
    """Merged labels, by the paper's steps and all pairs of points."""
    cells = np.floor((points - points.min(axis=0)) / spacing + 0.5)
    near = (np.abs(cells[:, None] - cells[None]) <= 1).all(axis=-1)
    labels = labels.copy()
    while True:
        best = (limit * spacing, -1, -1)
        for i, j in itertools.combinations(np.unique(labels), 2):
            if near[np.ix_(labels == i, labels == j)].any():
                union = (labels == i) | (labels == j)
                error = fit_ellipsoids(points[union], np.zeros(union.sum(), int), 1, spacing).errors[0]
                best = min(best, (error, i, j))
        if best[1] < 0:
            return np.unique(labels, return_inverse=True)[1]
        labels[labels == best[2]] = best[1]


@pytest.mark.parametrize("limit", [1.0, 2.0, 4.0])
def test_merge_agrees_with_all_pairs(limit):
    points = figure(count=300)
    spacing = 0.03
    split = split_frame(points, spacing, SMALL)
    merged = merge_frame(split, limit)
    expected = merge_reference(points, leaf_labels(split), spacing, limit)
    np.testing.assert_array_equal(merged[leaf_labels(split)], expected)


def test_merge_lowers_the_count_with_the_limit():
    split = split_frame(figure(), SPACING, SegmentationSettings())
    counts = [merge_frame(split, limit).max() + 1 for limit in (0.0, 1.0, 3.0, 100.0)]
    assert counts[0] == len(split.errors)
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[2] > counts[3]


def test_dynamic_programming_finds_the_optimum():
    rng = np.random.default_rng(3)
    old, new = rng.normal(size=(5, 3)), rng.normal(size=(4, 3))
    cost = rng.uniform(size=(5, 4))
    parent = np.array([0, 0, 0, 1, 1])
    candidates = np.tile(np.arange(4), (5, 1))

    def total(targets):
        shift = new[list(targets)] - old
        pairs = sum(np.linalg.norm(shift[i] - shift[parent[i]]) for i in range(1, 5))
        return cost[np.arange(5), list(targets)].sum() + 0.3 * pairs

    found = assign_tree(cost, candidates, np.arange(5), parent, old, new, 0.3)
    best = min(itertools.product(range(4), repeat=5), key=total)
    assert tuple(found) == best
    alone = assign_tree(cost, candidates, np.arange(5), parent, old, new, 0.0)
    np.testing.assert_array_equal(alone, cost.argmin(axis=1))


def blobs(centers: list[float], counts: list[int], seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = []
    for x, count in zip(centers, counts, strict=True):
        directions = rng.normal(size=(count, 3))
        parts.append(0.1 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [x, 0, 0])
    return np.concatenate(parts)


def as_split(points: np.ndarray, labels: np.ndarray) -> SplitFrame:
    """A frame with given leaves."""
    order = np.argsort(labels, kind="stable").astype(np.int32)
    origin = points.mean(axis=0)
    grid = ((points - origin) / SPACING)[order]
    starts = np.searchsorted(labels[order], np.arange(labels.max() + 2)).astype(np.int32)
    moments = np.array(
        [
            [
                len(p),
                *p.sum(axis=0),
                *(p[:, [0]] * p).sum(axis=0),
                *(p[:, [1]] * p[:, 1:]).sum(axis=0),
                (p[:, 2] ** 2).sum(),
            ]
            for p in np.split(grid, starts[1:-1])
        ]
    )
    return SplitFrame(grid, order, starts, moments, np.zeros(len(moments)), origin, SPACING)


THREE = blobs([0, 1, 2], [400, 400, 400])
NO_MERGE = SegmentationSettings(merge_error=0)


def test_duplicated_ellipsoid_is_split():
    before = first_frame(as_split(THREE, np.repeat([0, 1, 2], 400)), NO_MERGE)
    after = match_frame(before, as_split(THREE + np.array([0.05, 0, 0]), np.repeat([0, 1], [400, 800])), NO_MERGE)
    assert after.repaired >= 1
    np.testing.assert_array_equal(after.labels, np.repeat([0, 1, 2], 400))


def test_missing_ellipsoid_is_merged_into_the_nearest():
    before = first_frame(as_split(THREE, np.repeat([0, 1, 2], 400)), NO_MERGE)
    crowd = blobs([0.04, 1.04, 2.04, 2.4], [400, 400, 400, 100])
    after = match_frame(before, as_split(crowd, np.repeat([0, 1, 2, 3], [400, 400, 400, 100])), NO_MERGE)
    assert after.repaired == 0
    np.testing.assert_array_equal(after.labels, np.repeat([0, 1, 2, 2], [400, 400, 400, 100]))


@pytest.mark.parametrize("coherence", [0.0, 0.5])
def test_count_is_constant_under_planted_duplicates_and_missing(coherence):
    chosen = SegmentationSettings(merge_error=0, coherence_weight=coherence)
    frames = []
    for t, depth in enumerate([4, 3, 5, 1, 6, 4]):  # some frames come in few leaves, others in many
        points = figure(seed=t, count=500) + np.array([0.02 * t, 0, 0])
        frames.append(split_frame(points, 0.02, chosen.model_copy(update={"max_depth": depth})))
    paths = match_frames(frames, chosen)
    count = paths.ellipsoids.counts.shape[1]
    assert paths.ellipsoids.centers.shape == (6, count, 3)
    assert count == 16
    last = fit_ellipsoids(figure(seed=5, count=500) + np.array([0.1, 0, 0]), paths.labels[-1].astype(int), count, 0.02)
    np.testing.assert_allclose(paths.ellipsoids.errors[-1], last.errors, rtol=1e-6)
    assert paths.repaired[3] >= 14
    for labels, counts in zip(paths.labels, paths.ellipsoids.counts, strict=True):
        np.testing.assert_array_equal(np.bincount(labels, minlength=count), counts)
        assert (counts > 0).all()
    assert (np.linalg.det(paths.ellipsoids.rotations) > 0.999).all()


def test_ellipsoids_in_one_place_are_still_told_apart():
    # splitting by distance alone can't part these: the assignment one to one must
    points = np.concatenate([THREE[:400], THREE[:400] + 1e-6, THREE[:400] - 1e-6])
    before = first_frame(as_split(points, np.repeat([0, 1, 2], 400)), NO_MERGE)
    after = match_frame(before, as_split(THREE[:400] + np.array([0.5, 0, 0]), np.zeros(400, int)), NO_MERGE)
    assert sorted(np.unique(after.labels)) == [0, 1, 2]


def test_too_few_points_for_the_ellipsoids():
    before = first_frame(as_split(THREE, np.repeat([0, 1, 2], 400)), NO_MERGE)
    with pytest.raises(GeometryError, match="frame 4: its 2 points can't be divided into the 3"):
        match_frame(before, as_split(THREE[[0, 500]], np.zeros(2, int)), NO_MERGE, 4)


def test_frames_that_do_not_move_keep_their_ellipsoids():
    split = split_frame(figure(), SPACING, SMALL)
    paths = match_frames([split] * 3, SegmentationSettings(max_depth=4, merge_error=0))
    np.testing.assert_array_equal(paths.labels[0], paths.labels[2])
    assert not paths.repaired.any()
