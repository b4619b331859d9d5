"""Rigid bodies and skeleton from motion paths; grouping beside SciPy's unconstrained average linkage."""

from __future__ import annotations

import time

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.spatial.distance import squareform

from geomocap.bodies.connected_linkage import connected_linkage
from geomocap.bodies.local_rotations import local_rotations, turn_distances
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.bodies.ray_depths import place_samples
from geomocap.bodies.surface_graph import surface_graph
from geomocap.model.motion_paths import MotionPaths
from geomocap.skeleton.motion_skeleton import find_motion_skeleton
from tests.benchmarks.table import Row, measure
from tests.geomocap.moving_chains import chain, seen_by_single_cameras


def benchmark() -> list[Row]:
    """1500 samples of 10 bodies over 60 frames."""
    moving = chain(10, frames=60, samples=150)
    paths = MotionPaths(moving.positions)
    positions = moving.positions
    graph = surface_graph(positions, positions[:, 0], 10, 2.0)
    radius = max(0.03 * paths.diagonal, 2.5 * graph.spacing)
    weights = np.ones(positions.shape[:2])
    rotations = local_rotations(positions, positions[:, 0], weights, graph.geodesics(radius), radius)
    turns = turn_distances(rotations)
    flat = rotations.reshape(len(rotations), -1, 9)

    def turns_by_numpy() -> None:
        for i in range(len(flat)):
            cosine = (np.einsum("tc,ntc->nt", flat[i], flat) - 1.0) / 2.0
            np.percentile(np.arccos(np.clip(cosine, -1.0, 1.0)), 95, axis=1)

    alone, ray = seen_by_single_cameras(moving, 0.03)
    seen = np.ones(alone.shape[:2], bool)
    turned, shifted = moving.rotations[None, :, 0].copy(), moving.translations[None, :, 0].copy()

    def places_by_numpy() -> None:
        sure = np.eye(3) - (1 - 0.05**2) * ray[..., :, None] * ray[..., None, :]
        carried = sure @ turned
        normal = np.einsum("tji,ntjk->nik", turned[0], carried)
        right = np.einsum("ntji,ntj->ni", carried, alone - shifted)
        place = np.linalg.solve(normal, right[..., None])[..., 0]
        left = np.einsum("tij,nj->nti", turned[0], place) + shifted - alone
        across = left - (left * ray).sum(axis=2, keepdims=True) * ray
        np.sqrt(np.minimum((across**2).sum(axis=2), 0.05**2).mean(axis=1))

    start = time.perf_counter()
    turns_by_numpy()
    numpy_seconds = time.perf_counter() - start
    bodies = find_motion_bodies(paths)
    condensed = squareform(np.asarray(turns, float), checks=False)
    return [
        Row(
            "turn distances, 1500 samples, 60 frames",
            measure(lambda: turn_distances(rotations), 3),
            "NumPy",
            numpy_seconds,
        ),
        Row(
            "connected linkage, 1500 samples",
            measure(lambda: connected_linkage(turns, graph.neighbours), 3),
            "scipy linkage (not connected)",
            measure(lambda: linkage(condensed, "average"), 3),
        ),
        Row(
            "bodies, 1500 samples, 60 frames",
            measure(lambda: find_motion_bodies(paths), 1, warm_up=False),
            goal="10 s on a quiet machine",
            note=f"{bodies.body_count} bodies of 10",
        ),
        Row(
            "places of 1500 samples on a body, by one camera each",
            measure(lambda: place_samples(alone, seen, ray, turned, shifted, 0.05, 0.05), 3),
            "NumPy",
            measure(places_by_numpy, 3),
        ),
        Row("skeleton, 10 bodies, 60 frames", measure(lambda: find_motion_skeleton(bodies, 30.0), 1)),
    ]
