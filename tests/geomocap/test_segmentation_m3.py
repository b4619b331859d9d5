from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.model.ellipsoids import fit_ellipsoids
from geomocap.model.rotations import nearest_rotation
from geomocap.segmentation.m3 import segment_m3
from geomocap.segmentation.m3_result import Segmentation
from geomocap.segmentation.m3_settings import SegmentationSettings
from geomocap.segmentation.relative_paths import group_paths, path_integrals, similarity_threshold, unite
from tests.geomocap.articulated import alike
from tests.geomocap.segmentation_scenes import hinged_arm

SPACING = 0.008
SETTINGS = SegmentationSettings(max_depth=4, merge_error=1.0)


@pytest.fixture(scope="module")
def arm() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    return hinged_arm()


@pytest.fixture(scope="module")
def segmentation(arm) -> Segmentation:
    return segment_m3(arm[0], spacing=SPACING, settings=SETTINGS)


def test_bodies_keep_to_the_parts(arm, segmentation):
    _, part, _ = arm
    for labels in segmentation.labels:
        purity = sum(np.bincount(part[labels == b]).max() for b in np.unique(labels)) / len(part)
        assert purity > 0.95
    # what rests is one body; what swings takes several, since relative paths differ along a turning limb
    resting = segmentation.labels[0][part == 0]
    assert np.bincount(resting).max() > 0.9 * len(resting)


def test_shapes_and_counts(arm, segmentation):
    points, _, _ = arm
    shells = segmentation.ellipsoids
    frames, count = shells.counts.shape
    assert frames == len(points)
    assert shells.centers.shape == shells.radii.shape == (frames, count, 3)
    assert shells.rotations.shape == (frames, count, 3, 3)
    assert segmentation.body.shape == (count,)
    assert (np.diff(shells.radii, axis=-1) <= 0).all()
    assert (shells.counts.sum(axis=1) == [len(p) for p in points]).all()
    bodies = segmentation.body_count
    assert set(segmentation.body) == set(range(bodies))
    assert segmentation.body_positions.shape == (frames, bodies, 3)
    np.testing.assert_allclose(np.linalg.det(segmentation.body_rotations), 1.0)
    np.testing.assert_allclose(segmentation.body_rotations[0], np.tile(np.eye(3), (bodies, 1, 1)), atol=1e-12)
    assert (segmentation.contacts == segmentation.contacts.T).all()
    assert segmentation.touching.max() <= 1.0


def test_turns_are_those_of_the_limb(arm, segmentation):
    _, part, angles = arm
    labels = segmentation.labels[0]
    sizes = [np.sum(part[labels == b] == 1) for b in range(segmentation.body_count)]
    swinging = int(np.argmax(sizes))
    turns = np.array([Rotation.from_matrix(r).as_rotvec() for r in segmentation.body_rotations[:, swinging]])
    steps = np.linalg.norm(np.diff(turns, axis=0), axis=1)
    assert steps.max() < 0.6  # no flip of an axis
    assert np.corrcoef(turns[:, 2], angles)[0, 1] > 0.9


def test_body_ellipsoids_are_fitted_to_the_union(arm, segmentation):
    points, _, _ = arm
    fit = fit_ellipsoids(points[5], segmentation.body_labels(5), segmentation.body_count, SPACING)
    np.testing.assert_allclose(segmentation.bodies.centers[5], fit.centers, atol=1e-9)
    np.testing.assert_array_equal(segmentation.bodies.counts[5], fit.counts)
    np.testing.assert_allclose(segmentation.bodies.radii[5], fit.radii, atol=1e-4)


def test_the_same_whatever_the_executor(arm, segmentation):
    points, _, _ = arm
    with ThreadPoolExecutor(3) as executor:
        again = segment_m3(points.__getitem__, len(points), spacing=SPACING, settings=SETTINGS, executor=executor)
    alike(segmentation.ellipsoids, again.ellipsoids)
    np.testing.assert_array_equal(segmentation.body, again.body)
    np.testing.assert_array_equal(segmentation.body_rotations, again.body_rotations)


def test_scale_changes_lengths_only(arm, segmentation):
    points, _, _ = arm
    larger = segment_m3([p * 64.0 for p in points], spacing=SPACING * 64.0, settings=SETTINGS)
    np.testing.assert_array_equal(larger.body, segmentation.body)
    assert larger.threshold == pytest.approx(64.0 * segmentation.threshold)


def test_iterative_variant_takes_the_largest_first(arm):
    points, part, _ = arm
    result = segment_m3(points, spacing=SPACING, settings=SETTINGS.model_copy(update={"iterative": True}))
    labels = result.labels
    assert min(frame.min() for frame in labels) == 0
    first = np.bincount(part[labels[0] == 0], minlength=2)
    assert first[0] > 0.9 * 3000 and first[1] < 0.1 * 3000
    assert (result.ellipsoids.counts.sum(axis=1) == len(part)).all()
    for frame in (0, 7):
        expected = fit_ellipsoids(points[frame], result.point_ellipsoids[frame], len(result.body), SPACING)
        np.testing.assert_allclose(result.ellipsoids.centers[frame], expected.centers, atol=1e-9)


def test_a_single_scan_has_ellipsoids_and_no_bodies(arm):
    result = segment_m3(arm[0][:1], spacing=SPACING, settings=SETTINGS)
    assert result.body_count == 0
    assert (result.body == -1).all() and len(result.body) > 4
    assert (result.labels[0] == -1).all()
    assert len(np.unique(result.point_ellipsoids[0])) == len(result.body)


def test_a_subject_that_does_not_move_is_one_body(arm):
    # without merging, the ellipsoids of equal frames are equal
    settings = SegmentationSettings(max_depth=4, merge_error=0)
    result = segment_m3(arm[0][:1] * 3, spacing=SPACING, settings=settings)
    assert result.body_count == 1


def test_progress_reaches_every_frame(arm):
    seen = []
    segment_m3(arm[0][:3], spacing=SPACING, settings=SETTINGS, progress=lambda *report: seen.append(report))
    assert seen[0] == ("segment", 0, 3) and seen[-1] == ("segment", 3, 3)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda points: points.__setitem__(2, np.empty((0, 3))), "frame 2: no points"),
        (lambda points: points.__setitem__(1, points[1][:5]), "frame 1: only 5 points"),
        (lambda points: points.__setitem__(1, np.full((99, 3), np.nan)), "frame 1: 99 points are not finite"),
        (lambda points: points.clear(), "no frames to segment"),
    ],
)
def test_bad_frames_are_named(arm, change, text):
    points = list(arm[0][:3])
    change(points)
    with pytest.raises(GeometryError, match=text):
        segment_m3(points, spacing=SPACING, settings=SETTINGS)


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan])
def test_bad_spacing(arm, spacing):
    with pytest.raises(GeometryError, match="point spacing"):
        segment_m3(arm[0][:2], spacing=spacing)


def test_integrals_of_known_paths():
    t = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    wave = np.stack([np.sin(t), np.zeros(100), np.zeros(100)], axis=1)
    paths = np.stack([wave, wave + 5.0, -wave], axis=1)
    integrals = path_integrals(paths)
    assert integrals[0, 1] == pytest.approx(0.0, abs=1e-12)  # where a path is does not count
    assert integrals[0, 2] == pytest.approx(2 * np.abs(np.sin(t)).mean())


def test_seeds_walk_along_the_chain():
    # five ellipsoids in a row; 2 is at the centre of gravity, {1, 2} move alike
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [2.1, 0, 0], [3.5, 0, 0], [4.9, 0, 0]])
    integrals = np.full((5, 5), 9.0)
    integrals[1, 2] = integrals[2, 1] = 0.1
    np.fill_diagonal(integrals, 0)
    grouping = group_paths(integrals, centers, np.ones(5), 1.0)
    assert grouping.seeds.tolist() == [2, 0, 3, 4]
    assert grouping.body.tolist() == [1, 0, 0, 2, 3]


def test_threshold_follows_the_scale_of_the_motion():
    rng = np.random.default_rng(0)
    integrals = np.exp(rng.normal(size=(30, 30)))
    integrals = integrals + integrals.T
    assert similarity_threshold(2 * integrals) == pytest.approx(2 * similarity_threshold(integrals))
    assert similarity_threshold(np.zeros((1, 1))) == similarity_threshold(np.ones((2, 2))) == 0.0


def test_threshold_lies_between_pairs_of_one_body_and_others():
    body = np.repeat([0, 1, 2], [6, 3, 2])
    rng = np.random.default_rng(1)
    integrals = np.where(body[:, None] == body, 0.01, 0.2) * np.exp(0.3 * rng.normal(size=(11, 11)))
    integrals = np.minimum(integrals, integrals.T)
    within = integrals[(body[:, None] == body) & ~np.eye(11, dtype=bool)]
    assert within.max() < similarity_threshold(integrals) < integrals[body[:, None] != body].min()


def test_threshold_is_the_best_of_all_cuts():
    pairs = np.random.default_rng(2).lognormal(size=45)
    integrals = np.zeros((10, 10))
    integrals[np.triu_indices(10, 1)] = pairs
    logs = np.sort(np.log(pairs))

    def between(cut: int) -> float:
        return cut * (45 - cut) * (logs[:cut].mean() - logs[cut:].mean()) ** 2

    best = max(range(1, 45), key=between)
    assert similarity_threshold(integrals) == pytest.approx(np.exp(logs[best - 1 : best + 1].mean()))


def test_union_of_one_ellipsoid_is_itself(segmentation):
    same = unite(segmentation.ellipsoids, np.arange(len(segmentation.body)), len(segmentation.body))
    np.testing.assert_allclose(same.centers, segmentation.ellipsoids.centers, atol=1e-12)
    np.testing.assert_allclose(same.radii, segmentation.ellipsoids.radii, atol=1e-9)


def test_nearest_rotation_of_a_mirrored_matrix_is_proper():
    assert np.linalg.det(nearest_rotation(np.diag([3.0, 2.0, -1.0]))) == pytest.approx(1.0)
    turn = Rotation.from_rotvec([0.1, 2.0, -0.4]).as_matrix()
    np.testing.assert_allclose(nearest_rotation(5.0 * turn), turn, atol=1e-12)
