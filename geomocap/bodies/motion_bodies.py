"""Rigid bodies found from motion paths: their number, samples, soft borders and motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from geomocap.bodies.body_elimination import EliminationStep, confidences, eliminate
from geomocap.bodies.body_evidence import Criterion
from geomocap.bodies.body_model import BodyModel, Evidence, carry, model_of_labels, reassign, refit, settle_rest
from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.connected_linkage import Dendrogram, connected_linkage
from geomocap.bodies.local_rotations import local_rotations, turn_distances
from geomocap.bodies.path_smoothing import smooth_paths
from geomocap.bodies.surface_graph import SurfaceGraph, surface_graph
from geomocap.bodies.surface_noise import SurfaceNoise, surface_noise
from geomocap.errors import GeometryError
from geomocap.model.motion_paths import MotionPaths, sure_part
from geomocap.progress import Progress, silent
from geomocap.trajectories.completion import complete_tracks

_LEAST_SAMPLES = 20
_CERTAIN = 0.3
_SETTLE_ROUNDS = 3
_EARLY_FRACTION = 0.8  # small groups may still grow
_IS_ONE = 0.5  # confidence of a body that explains just what is required
_FEIGNED = 7.81  # 95th percentile of χ² of the three angles of a turn by noise
_ARM = 0.4  # radii
_MOST_RADIUS = 3.0  # times the radius asked for
_STAGE = "bodies"


@dataclass(frozen=True)
class MotionBodies:
    """B rigid bodies of N samples over T frames.

    A body is a part of the surface that turns, somewhere in the sequence, at least `min_turn_deg` against each
    neighbour, and explains more motion that these and blends of them do not than its freedoms cost.

    Attributes
    ----------
    label : (N,) int32
        Body of each sample; -1: none.
    weights : (N, B) float
        Skin weights: at soft borders a sample follows two bodies; rows sum to 1.
    rotations : (T, B, 3, 3) float
        Since frame 0, world axes.
    translations : (T, B, 3) float, metres
        position(t) = rotation @ position(0) + translation.
    reliability : (T, B) float
        Fraction of a body's samples that are seen in a frame and follow the body, 0 to 1.
    rest : (N, 3) float, metres, world
        Positions of the samples in frame 0.
    positions : (N, T, 3) float, metres, world
        Of the samples, gaps filled.
    residuals : (N,) float, metres
        Root mean square distance of a sample from where its bodies carry it.
    lasting : (N, N) float32, metres
        Lasting distance of each two samples, see `surface_graph.lasting_distances`.
    adjacency : (N, N) csr_matrix
        Neighbours on the surface.
    curve : tuple of EliminationStep
        Number of bodies as a function of how strict the criterion is, with the bodies at each step: the alternatives.
    linkage : Dendrogram
        Tree of the first grouping, whose cuts are the alternatives.
    diagonal : float, metres
    unevenness : float, radians
        By which samples turn differently from those beside them, median: mostly how unsure the turns are.
    confidence : (B,) float
        How sure it is that each body is one, 0 to 1: 1/2 where its turn or evidence is just what is required, 2/3 where
        it is twice that. Bodies of less are merged, unless their number was given.
    noise : float, metres
        Root mean square by which the surface around a sample misses where it goes: what is noise, and what is soft.
    """

    label: np.ndarray
    weights: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    reliability: np.ndarray
    rest: np.ndarray
    positions: np.ndarray
    residuals: np.ndarray
    lasting: np.ndarray
    adjacency: csr_matrix
    curve: tuple[EliminationStep, ...]
    linkage: Dendrogram
    diagonal: float
    unevenness: float
    confidence: np.ndarray
    noise: float

    @property
    def body_count(self) -> int:
        """Number of bodies B."""
        return self.rotations.shape[1]

    @property
    def centers(self) -> np.ndarray:
        """Centres of the bodies, (T, B, 3), metres, world: mean of their samples at rest, carried."""
        middle = np.stack([self.rest[self.label == b].mean(axis=0) for b in range(self.body_count)])
        return np.einsum("tbij,bj->tbi", self.rotations, middle) + self.translations

    def alternatives(self, most: int = 8) -> np.ndarray:
        """Bodies of the samples if the criterion were a little weaker or stricter, (A, N) int32, nearest numbers first.

        Where a trunk bends in many small steps, one cut is as good as another.
        """
        others = {step.bodies: step.label for step in self.curve if step.bodies != self.body_count}
        nearest = sorted(others, key=lambda count: (abs(count - self.body_count), -count))[:most]
        return np.array([others[count] for count in nearest], np.int32).reshape(-1, len(self.label))


def find_motion_bodies(
    paths: MotionPaths, settings: MotionBodiesSettings | None = None, progress: Progress = silent
) -> MotionBodies:
    """Find the rigid bodies that move the samples.

    Every sample's neighbourhood on the surface has a rotation since frame 0, whatever lever arms there are. Samples
    that turn alike are grouped (average linkage along the surface), too finely, unless the paths say which rigid parts
    they are of. Each group gets a rigid motion, each sample follows one body or a blend of two, and then the weakest
    body goes, again and again, until each one left turns against its neighbours and pays for its freedoms: it explains
    motion that blends of the neighbours do not, beyond the noise that is everywhere on the surface and the softness of
    skin (`body_evidence`). A rigid part was registered on its own: it is no skin, and its turn is known better.

    Parameters
    ----------
    paths : MotionPaths
    settings : MotionBodiesSettings, optional
    progress : Progress, optional

    Returns
    -------
    MotionBodies

    Raises
    ------
    GeometryError
        If there are too few samples.
    """
    settings = settings or MotionBodiesSettings()
    if paths.count < _LEAST_SAMPLES:
        raise GeometryError(f"motion paths: {paths.count} samples; at least {_LEAST_SAMPLES} are needed to find bodies")
    diagonal = paths.diagonal
    # Paths without gaps, the surface, and how it turns
    positions, certainty = complete_tracks(paths)
    weights = np.where(paths.seen, paths.weights(), 0.1 * certainty)
    smooth = smooth_paths(positions)
    reference = smooth[:, 0]  # of samples that are not seen there, as their neighbours carry them back
    graph = surface_graph(smooth, reference, settings.neighbours, settings.max_stretch)
    noise = surface_noise(smooth, weights, reference, paths.ray, graph, diagonal)
    progress(_STAGE, 1, 4)
    first_cut = np.deg2rad(settings.first_cut_deg)
    geodesics, radius = _wide_enough(graph, noise, max(settings.radius * diagonal, 2.5 * graph.spacing), first_cut)
    rotations = local_rotations(smooth, reference, weights, geodesics, radius)
    turns = turn_distances(_known_rotations(paths, rotations), certainty > _CERTAIN)
    progress(_STAGE, 2, 4)
    # Too many bodies
    evidence = _evidence(smooth, weights, paths, reference, turns, graph, diagonal, settings)
    linkage = connected_linkage(turns, graph.neighbours)
    least = max(6, round(_EARLY_FRACTION * settings.min_fraction * paths.count))
    label = absorb_small(linkage.cut(first_cut) if paths.parts is None else paths.parts, turns, graph, least)
    if settings.bodies > int(label.max()) + 1:
        label = linkage.cut_count(settings.bodies)
    model, evidence = _settled(reassign(model_of_labels(label, evidence), evidence, 4).compact(), evidence)
    progress(_STAGE, 3, 4)
    # Those that are there
    criterion = _criterion(settings, noise, rigid=paths.parts is not None)
    model, evidence, curve, confidence = _those_that_are_there(model, evidence, criterion, settings.bodies)
    progress(_STAGE, 4, 4)
    evidence = replace(evidence, positions=positions)
    return _result(model, evidence, paths, graph, curve, linkage, diagonal, confidence, noise)


def _those_that_are_there(
    model: BodyModel, evidence: Evidence, criterion: Criterion, count: int
) -> tuple[BodyModel, Evidence, tuple[EliminationStep, ...], np.ndarray]:
    """Take bodies away until each is one, also after samples have chosen their bodies anew; `count` 0: found."""
    curve: tuple[EliminationStep, ...] = ()
    while True:
        left = eliminate(model, evidence, criterion, count or None)
        curve = (*(step for step in curve if step.bodies > left.curve[0].bodies), *left.curve)
        evidence = left.evidence
        model = reassign(left.model, evidence, 3).compact()
        confidence = confidences(model, evidence, criterion)
        if count or (confidence >= _IS_ONE).all():
            if evidence.ray is None:  # the borders before that are truer
                model, confidence = left.model, confidences(left.model, evidence, criterion)
            return model, evidence, curve, confidence


def _criterion(settings: MotionBodiesSettings, noise: SurfaceNoise, rigid: bool) -> Criterion:
    """When a body is one; rigid parts turn as a whole, and none that points suit on its own is a piece of soft skin."""
    turn, softness = (settings.part_turn_deg, 0.0) if rigid else (settings.min_turn_deg, settings.soft_fraction)
    return Criterion(np.deg2rad(turn), noise, settings.min_fraction, softness)


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
    diagonal: float,
    settings: MotionBodiesSettings,
) -> Evidence:
    near = csr_matrix(np.isfinite(graph.geodesics(max(settings.reach * diagonal, 3.0 * graph.spacing))).astype(float))
    certain = paths.seen[:, 0] if paths.ray is None else paths.seen[:, 0] & ~paths.ray[:, 0].any(axis=1)
    return Evidence(
        positions,
        weights,
        paths.seen,
        paths.typical_sigma(),
        paths.ray,
        rest,
        certain,
        turns,
        _unevenness(turns, graph.adjacency),
        graph.adjacency,
        near,
        settings.blend_penalty * diagonal if settings.blends else np.inf,
        settings.largest_residual * diagonal,
        2e-4 * diagonal,
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


def _result(
    model: BodyModel,
    evidence: Evidence,
    paths: MotionPaths,
    graph: SurfaceGraph,
    curve: tuple[EliminationStep, ...],
    linkage: Dendrogram,
    diagonal: float,
    confidence: np.ndarray,
    noise: SurfaceNoise,
) -> MotionBodies:
    memberships = model.memberships()
    carried = np.zeros_like(evidence.positions)
    for b in range(model.count):
        some = np.flatnonzero(memberships[:, b] > 0)
        moved = carry(model.rotations[b], model.translations[b], evidence.rest[some])
        carried[some] += memberships[some, b][:, None, None] * moved
    miss = np.linalg.norm(sure_part(carried - evidence.positions, evidence.ray), axis=2)
    total = np.maximum(evidence.weights.sum(axis=1), 1e-12)
    residuals = np.sqrt((evidence.weights * miss**2).sum(axis=1) / total)
    follows = paths.seen & (miss < max(4.0 * float(np.median(residuals)), 0.005 * diagonal))
    reliability = np.stack([follows[model.label == b].mean(axis=0) for b in range(model.count)], axis=1)
    # motions counted from frame 0
    first, start = model.rotations[:, 0], model.translations[:, 0]
    rotations = np.einsum("btij,bkj->tbik", model.rotations, first)
    translations = model.translations.swapaxes(0, 1) - np.einsum("tbij,bj->tbi", rotations, start)
    rest = np.einsum("nb,nbi->ni", memberships, np.einsum("bij,nj->nbi", first, evidence.rest) + start)
    return MotionBodies(
        model.label.astype(np.int32),
        memberships,
        rotations,
        translations,
        reliability,
        rest,
        evidence.positions,
        residuals,
        graph.lasting,
        graph.adjacency,
        curve,
        linkage,
        diagonal,
        float(np.median(evidence.unevenness)),
        confidence,
        float(np.sqrt(noise.variance)),
    )
