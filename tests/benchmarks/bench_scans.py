"""Scans sampled afresh in each frame: bodies of two made-up subjects, beside k-means of the same nodes' paths."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import trimesh
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from data_tools.asset import AnimatedAsset
from data_tools.figure import figure, mechanism
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.bodies.point_labels import Voters, label_points
from geomocap.evaluation.body_scores import adjusted_rand_index
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_tracking import NodeTracks, track_nodes
from geomocap.skeleton.motion_skeleton import find_motion_skeleton
from tests.benchmarks.table import Row

T = TypeVar("T")

FRAMES = 30
POINTS = 4096
LOOKED_AT = range(0, FRAMES, 5)


def benchmark() -> list[Row]:
    """A machine on a base and a figure that stands free, stage by stage."""
    return [*_rows("machine", mechanism()), *_rows("figure", figure())]


def _rows(name: str, asset: AnimatedAsset) -> list[Row]:
    frames, true = zip(*(_scan(asset, frame) for frame in range(FRAMES)), strict=True)
    settings = NodeTrackingSettings()
    skin, following = _timed(lambda: _track(frames, settings.model_copy(update={"part_rounds": 0})))
    nodes, together = _timed(lambda: _track(frames, settings))
    paths = nodes.motion_paths()
    bodies, finding = _timed(lambda: find_motion_bodies(paths))
    _, joining = _timed(lambda: find_motion_skeleton(bodies, 30.0))
    voters = Voters.of(bodies, paths)
    ours = np.mean([adjusted_rand_index(label_points(voters, k, frames[k]), true[k]) for k in LOOKED_AT])
    count = len(asset.joint_names)
    clusters, clustering = _timed(lambda: _by_kmeans(skin, count))
    nearest = [cKDTree(skin.positions[:, k]).query(frames[k])[1] for k in LOOKED_AT]
    beside = np.mean([adjusted_rand_index(clusters[n], true[k]) for n, k in zip(nearest, LOOKED_AT, strict=True)])
    task = f"{name}, {FRAMES} frames of {POINTS:,} points"
    return [
        Row(f"nodes of a skin, {task}", following),
        Row(f"rigid parts, {task}", together - following, goal="with nodes and bodies ≤ 40 s on two idle cores"),
        Row(
            f"bodies, {task}",
            finding,
            "k-means of the nodes' paths, the true number given",
            clustering,
            note=f"adjusted Rand index {ours:.2f} with {bodies.body_count} of {count} bodies; k-means {beside:.2f}",
        ),
        Row(f"skeleton, {task}", joining),
    ]


def _scan(asset: AnimatedAsset, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (POINTS, 3), metres, drawn at random on all parts' surfaces, and their bodies (POINTS,)."""
    mesh = trimesh.Trimesh(asset.vertices(asset.duration * frame / FRAMES), asset.faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, POINTS, seed=frame)
    return np.asarray(points), asset.vertex_weights.argmax(axis=1)[asset.faces[face, 0]]


def _track(frames: tuple[np.ndarray, ...], settings: NodeTrackingSettings) -> NodeTracks:
    return track_nodes(lambda k: frames[k], FRAMES, settings)


def _by_kmeans(nodes: NodeTracks, count: int) -> np.ndarray:
    """Groups of the nodes by their places in all frames; where a node is lost, it is at its middle place."""
    middle = np.nanmean(nodes.positions, axis=1, keepdims=True)
    places = np.where(np.isfinite(nodes.positions), nodes.positions, middle)
    return kmeans2(places.reshape(len(places), -1), count, minit="++", seed=0)[1]


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start
