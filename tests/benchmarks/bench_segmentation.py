"""Segmentation and skeleton: 25,000 surface points a frame, 220 frames, beside what a user would pick instead."""

from __future__ import annotations

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.model.ellipsoids import fit_ellipsoids
from geomocap.segmentation.axis_joints import grow_joints
from geomocap.segmentation.body_rotations import body_rotations, carried_bodies
from geomocap.segmentation.contacts import count_contacts
from geomocap.segmentation.ellipsoid_matching import match_frames
from geomocap.segmentation.ellipsoid_merging import merge_frame, merge_leaves
from geomocap.segmentation.ellipsoid_splitting import split_frame
from geomocap.segmentation.m3 import segment_m3
from geomocap.segmentation.m3_settings import SegmentationSettings
from geomocap.segmentation.relative_paths import group_paths, path_integrals, similarity_threshold, unite
from geomocap.skeleton.m3_skeleton import skeleton_m3
from tests.benchmarks.table import Row, measure

SPACING = 0.0113
FRAMES = 220
_EVERY = 300  # of the surface's points are tracked


def _capsule(rng: np.random.Generator, length: float, radius: float) -> np.ndarray:
    count = int(1.6e6 * length * radius * 2 * np.pi)
    along = rng.uniform(-radius, length + radius, count)
    beyond = np.maximum(np.maximum(-along, along - length), 0.0)
    turn = rng.uniform(0, 2 * np.pi, count)
    ring = np.sqrt(radius**2 - beyond**2)
    return np.stack([along, ring * np.cos(turn), ring * np.sin(turn)], axis=1)


def _surface(angle: float) -> np.ndarray:
    """The same points of the surface of a person of capsules whose arms and legs swing, (N, 3)."""
    rng = np.random.default_rng(0)
    down = Rotation.from_rotvec([0, np.pi / 2, 0])
    trunk, head = down.apply(_capsule(rng, 0.42, 0.17)), down.apply(_capsule(rng, 0.08, 0.11))
    parts = [trunk + np.array([0, 0, 1.4]), head + np.array([0, 0, 1.75])]
    for side in (-1, 1):
        for at, upper, radius in ([side * 0.22, 0, 1.42], 0.30, 0.05), ([side * 0.1, 0, 0.86], 0.4, 0.08):
            swing = Rotation.from_rotvec([side * 0.6 * np.sin(angle), 0, 0])
            bend = Rotation.from_rotvec([-0.4 * (1 + np.sin(angle)), 0, 0])
            parts.append(swing.apply(down.apply(_capsule(rng, upper, radius))) + at)
            joint = swing.apply(down.apply([[upper + radius, 0, 0]]))[0] + at
            parts.append((swing * bend).apply(down.apply(_capsule(rng, upper, radius * 0.8))) + joint)
    return np.concatenate(parts)


def _figure(angle: float) -> np.ndarray:
    """Surface voxels of that person, (N, 3)."""
    return (np.unique(np.floor(_surface(angle) / SPACING).astype(np.int64), axis=0) + 0.5) * SPACING


def _split_numpy(points: np.ndarray, depth: int) -> list[np.ndarray]:
    """The same split with NumPy's eigenvectors."""
    fit = np.zeros(len(points), int)
    ellipsoid = fit_ellipsoids(points, fit, 1, SPACING)
    _, axes = np.linalg.eigh(np.cov(points.T))
    if depth == 0 or ellipsoid.errors[0] < 0.2 * SPACING or len(points) < 32:
        return [points]
    below = (points - points.mean(axis=0)) @ axes[:, 2] < 0
    return _split_numpy(points[below], depth - 1) + _split_numpy(points[~below], depth - 1)


def _contacts_kdtree(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    pairs = cKDTree(points).query_pairs(1.75, output_type="ndarray")
    count = labels.max() + 1
    contacts = np.zeros((count, count), int)
    np.add.at(contacts, (labels[pairs[:, 0]], labels[pairs[:, 1]]), 1)
    return contacts


def benchmark() -> list[Row]:
    """Time split, merge, matching with bodies, joints, and the whole."""
    settings = SegmentationSettings()
    period = [_figure(2 * np.pi * k / 20) for k in range(20)]
    points = period[0]
    rows = []

    split = split_frame(points, SPACING, settings)
    leaves = len(split.errors)
    rows.append(
        Row(
            f"split {len(points)} points, {leaves} leaves",
            measure(lambda: split_frame(points, SPACING, settings), 9),
            "scipy kmeans2, as many clusters",
            measure(lambda: kmeans2(points, leaves, minit="++", iter=10, seed=0), 1, warm_up=False),
            "≤ 5 ms",
            f"NumPy with the same cuts {1000 * measure(lambda: _split_numpy(points, 7), 3):.0f} ms",
        )
    )
    labels = split.leaves
    contacts = count_contacts(split.points, labels, leaves)
    kernel = measure(
        lambda: merge_leaves(
            split.points, split.starts.astype(np.int64), split.moments, contacts, settings.merge_error
        ),
        9,
    )
    rows.append(
        Row(
            f"merge {leaves} leaves to {merge_frame(split, settings.merge_error).max() + 1}, contacts included",
            measure(lambda: merge_frame(split, settings.merge_error), 9),
            "scipy cKDTree, contacts alone",
            measure(lambda: _contacts_kdtree(split.points, labels), 3),
            "≤ 10 ms",
            f"without contacts {1000 * kernel:.1f} ms",
        )
    )
    splits = [split_frame(p, SPACING, settings) for p in period]
    sequence = [splits[k % 20] for k in range(FRAMES)]

    def match_and_group() -> None:
        paths = match_frames(sequence, settings)
        integrals = path_integrals(paths.ellipsoids.centers)
        first = paths.ellipsoids
        threshold = similarity_threshold(integrals)
        grouping = group_paths(integrals, first.centers[0], first.counts[0], threshold)
        bodies = unite(paths.ellipsoids, grouping.body, len(grouping.seeds))
        body_rotations(paths.ellipsoids, grouping.body, bodies)

    rows.append(Row(f"match + bodies, {FRAMES} frames", measure(match_and_group, 3), goal="≤ 2 s"))
    angles = 2 * np.pi * np.arange(FRAMES) / 20
    tracks = np.stack([_surface(angle)[::_EVERY] for angle in angles], axis=1)

    def carry_and_group() -> None:
        paths = match_frames(sequence, settings, tracks)
        assert paths.motion is not None
        integrals = paths.motion.integrals()
        first = paths.ellipsoids
        grouping = group_paths(integrals, first.centers[0], first.counts[0], similarity_threshold(integrals))
        carried_bodies(first, grouping.body, paths.motion, len(grouping.seeds))

    rows.append(Row(f"the same, carried by {len(tracks)} tracked points", measure(carry_and_group, 1)))
    result = segment_m3([period[k % 20] for k in range(60)], spacing=SPACING, settings=settings)
    skeleton = skeleton_m3(result, 15)
    bodies, pairs = result.bodies, skeleton.joint_bodies
    joints = measure(lambda: grow_joints(bodies.centers, bodies.radii, bodies.rotations, pairs, SPACING / 2), 5) / 60
    rows.append(
        Row(
            f"joints of {len(pairs)} pairs, a frame",
            joints,
            goal="≤ 5 ms",
            note=f"with hierarchy and motion {1000 * measure(lambda: skeleton_m3(result, 15), 3) / 60:.2f} ms",
        )
    )
    return rows
