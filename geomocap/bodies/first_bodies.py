"""More bodies than there are, as a start: groups of samples that turn alike, and their motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from geomocap.bodies.body_model import BodyModel, Evidence, model_of_labels, reassign, refit, settle_rest
from geomocap.bodies.body_settings import FOLLOWED, MotionBodiesSettings
from geomocap.bodies.connected_linkage import Dendrogram, connected_linkage
from geomocap.bodies.local_rotations import local_rotations, turn_distances
from geomocap.bodies.path_smoothing import smooth_paths
from geomocap.bodies.surface_graph import SurfaceGraph, surface_graph
from geomocap.bodies.surface_noise import SurfaceNoise, surface_noise
from geomocap.model.motion_paths import MotionPaths

_CERTAIN = 0.3
_SETTLE_ROUNDS = 3
_EARLY_FRACTION = 0.8  # small groups may still grow
_FEIGNED = 7.81  # 95th percentile of χ² of the three angles of a turn by noise
_ARM = 0.4  # radii
_MOST_RADIUS = 3.0  # times the radius asked for


@dataclass(frozen=True)
class FirstBodies:
    """More bodies than there are, and what they were found from.

    Attributes
    ----------
    graph : SurfaceGraph
    noise : SurfaceNoise
    linkage : Dendrogram
        Tree of the groups of samples that turn alike.
    model : BodyModel
    evidence : Evidence
        With places at rest from all frames.
    """

    graph: SurfaceGraph
    noise: SurfaceNoise
    linkage: Dendrogram
    model: BodyModel
    evidence: Evidence


def first_bodies(
    positions: np.ndarray, certainty: np.ndarray, paths: MotionPaths, settings: MotionBodiesSettings
) -> FirstBodies:
    """Find groups of samples that turn alike, too finely, and the motion of these.

    Parameters
    ----------
    positions, certainty : (N, T, 3) float, metres; (N, T) float
        Without gaps, and how sure the positions are: 1 where seen.
    paths : MotionPaths
    settings : MotionBodiesSettings
    """
    diagonal = paths.diagonal
    weights = np.ascontiguousarray(np.where(paths.seen, paths.weights(), 0.1 * certainty))
    smooth = smooth_paths(positions)
    reference = smooth[:, 0]  # of samples that are not seen there, as their neighbours carry them back
    graph = surface_graph(smooth, reference, settings.neighbours, settings.max_stretch)
    noise = surface_noise(smooth, weights, reference, paths.ray, graph, diagonal)
    first_cut = np.deg2rad(settings.first_cut_deg)
    geodesics, radius = _wide_enough(graph, noise, max(settings.radius * diagonal, 2.5 * graph.spacing), first_cut)
    rotations = local_rotations(smooth, reference, weights, geodesics, radius)
    turns = turn_distances(_known_rotations(paths, rotations), certainty > _CERTAIN)
    evidence = _evidence(smooth, weights, paths, reference, turns, graph, noise, diagonal, settings)
    linkage = connected_linkage(turns, graph.neighbours)
    least = max(6, round(_EARLY_FRACTION * settings.min_fraction * paths.count))
    label = absorb_small(linkage.cut(first_cut) if paths.parts is None else paths.parts, turns, graph, least)
    if settings.bodies > int(label.max()) + 1:
        label = linkage.cut_count(settings.bodies)
    model, evidence = _settled(reassign(model_of_labels(label, evidence), evidence, 4).compact(), evidence)
    return FirstBodies(graph, noise, linkage, model, evidence)


def _wide_enough(graph: SurfaceGraph, noise: SurfaceNoise, radius: float, first_cut: float) -> tuple[np.ndarray, float]:
    """Geodesics and radius of neighbourhoods so large that their turns by noise are less than those of the first cut.

    Gaussian weights leave a disc of radius r an arm of 0.4 r about each axis, so that noise of standard deviation σ
    turns n samples by σ / (√n 0.4 r) about it, and two such discs against each other by √2 times that.
    """
    most = _MOST_RADIUS * radius
    while True:
        geodesics = graph.geodesics(radius)
        samples = float(np.median((geodesics <= radius).sum(axis=1)))
        feigned = np.sqrt(_FEIGNED * 2.0 * noise.variance / 3.0 / samples) / (_ARM * radius)
        if feigned < first_cut or 1.25 * radius > most:
            return geodesics, radius
        radius *= 1.25


def _settled(model: BodyModel, evidence: Evidence) -> tuple[BodyModel, Evidence]:
    """Places at rest from all frames, by the first bodies: frame 0 is as noisy as any other.

    From then on all bodies carry the same shape; only samples that were not seen in frame 0, or not surely, may lie
    elsewhere for another body.
    """
    for _ in range(_SETTLE_ROUNDS):
        settled = settle_rest(model, evidence.with_places_open())
        evidence = replace(evidence, rest=settled.rest)
        model = reassign(refit(model, settled, np.arange(model.count)), settled, 1).compact()
    return reassign(refit(model, evidence, np.arange(model.count)), evidence, 1).compact(), evidence


def _known_rotations(paths: MotionPaths, fitted: np.ndarray) -> np.ndarray:
    if paths.rotations is None:
        return fitted
    known = np.isfinite(paths.rotations).all(axis=(2, 3))
    return np.where(known[..., None, None], paths.rotations, fitted)


def _evidence(
    positions: np.ndarray,
    weights: np.ndarray,
    paths: MotionPaths,
    rest: np.ndarray,
    turns: np.ndarray,
    graph: SurfaceGraph,
    noise: SurfaceNoise,
    diagonal: float,
    settings: MotionBodiesSettings,
) -> Evidence:
    near = csr_matrix(np.isfinite(graph.geodesics(max(settings.reach * diagonal, 3.0 * graph.spacing))).astype(float))
    stated = paths.typical_sigma()
    certain = paths.seen[:, 0] if paths.ray is None else paths.seen[:, 0] & ~paths.ray[:, 0].any(axis=1)
    return Evidence(
        positions,
        weights,
        paths.seen,
        # with a rigid part samples move alike, and show no noise
        noise.calibrated(stated) if paths.parts is None else stated,
        paths.ray,
        rest,
        certain,
        turns,
        _unevenness(turns, graph.adjacency),
        graph.adjacency,
        near,
        settings.blend_penalty * diagonal if settings.blends else np.inf,
        settings.largest_residual * diagonal,
        FOLLOWED * diagonal,
        settings.smoothness,
    )


def _unevenness(turns: np.ndarray, adjacency: csr_matrix) -> np.ndarray:
    beside = np.split(adjacency.indices, adjacency.indptr[1:-1])
    return np.array([np.median(turns[i, others]) if len(others) else 0.0 for i, others in enumerate(beside)])


def absorb_small(label: np.ndarray, turns: np.ndarray, graph: SurfaceGraph, least: int) -> np.ndarray:
    """Give groups of fewer samples to the neighbouring group that turns most alike, the smallest first."""
    label = label.copy()
    linked = graph.neighbours
    while True:
        groups, counts = np.unique(label, return_counts=True)
        if counts.min() >= least or len(groups) == 1:
            return np.unique(label, return_inverse=True)[1]
        small = label == groups[np.argmin(counts)]
        others = np.unique(label[linked[small].any(axis=0) & ~small])
        if not len(others):
            outside = np.flatnonzero(~small)
            nearest = graph.lasting[np.ix_(small, outside)].min(axis=0).argmin()
            others = label[outside[[nearest]]]
        differences = [np.median(turns[np.ix_(small, label == g)]) for g in others]
        label[small] = others[int(np.argmin(differences))]
