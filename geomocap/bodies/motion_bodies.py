"""Rigid bodies found from motion paths: their number, samples, soft borders and motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_elimination import EliminationStep, confidences, eliminate
from geomocap.bodies.body_evidence import confidence_of
from geomocap.bodies.body_model import BodyModel, Evidence, reassign
from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.connected_linkage import Dendrogram
from geomocap.bodies.first_bodies import FirstBodies, first_bodies
from geomocap.bodies.surface_noise import SurfaceNoise
from geomocap.errors import GeometryError
from geomocap.model.motion_paths import MotionPaths, sure_part
from geomocap.progress import Progress, silent
from geomocap.trajectories.completion import complete_tracks

LEAST_SAMPLES = 20
_STAGE = "bodies"
_IS_ONE = 0.5  # confidence of a body that explains just what is required


@dataclass(frozen=True)
class MotionBodies:
    """B rigid bodies of N samples over T frames.

    A body is a part of the surface that turns, somewhere in the sequence, at least `min_turn_deg` against each
    neighbour, or slides as far over it, and explains more motion that these and blends of them do not than its freedoms
    cost.

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

    def merged(self, kept: int, gone: int) -> MotionBodies:
        """Bodies of which one takes the samples of another and carries them by its own motion; later numbers move up.

        Confidence is that of the surer of the two, reliability the mean over their samples.
        """
        sizes = np.bincount(self.label[self.label >= 0], minlength=self.body_count)
        left = np.arange(self.body_count) != gone
        number = np.cumsum(left) - 1
        number[gone] = number[kept]
        weights, reliability, confidence = self.weights.copy(), self.reliability.copy(), self.confidence.copy()
        weights[:, kept] += weights[:, gone]
        pair = [kept, gone]
        reliability[:, kept] = np.average(reliability[:, pair], axis=1, weights=sizes[pair])
        confidence[kept] = confidence[pair].max()
        return replace(
            self,
            label=np.where(self.label >= 0, number[self.label], -1).astype(np.int32),
            weights=weights[:, left],
            rotations=self.rotations[:, left],
            translations=self.translations[:, left],
            reliability=reliability[:, left],
            confidence=confidence[left],
        )

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
    they are of. Gaps, filled from frame to frame by neighbours, are filled anew by the motion of these groups, the more
    so the longer they are, and the groups found once more: errors don't add up along a gap. Each sample follows one
    body or a blend of two, and then the weakest body goes, again and again, until each one left turns against its
    neighbours and pays for its freedoms: it explains motion that blends of the neighbours do not, beyond the noise that
    is everywhere on the surface and the softness of skin (`body_evidence`). A rigid part was registered on its own:
    it is no skin, and its turn is known better.

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
    if paths.count < LEAST_SAMPLES:
        raise GeometryError(f"motion paths: {paths.count} samples; at least {LEAST_SAMPLES} are needed to find bodies")
    # Too many bodies
    positions, certainty = complete_tracks(paths)
    first = first_bodies(positions, certainty, paths, settings)
    progress(_STAGE, 1, 3)
    if paths.ray is None and not paths.seen.all():  # where rays leave depths open, rounds of these do as much
        sure = certainty[..., None]
        positions = sure * positions + (1.0 - sure) * first.model.carry(first.evidence.rest)
        first = first_bodies(positions, certainty, paths, settings)
    progress(_STAGE, 2, 3)
    # Those that are there
    criterion = _criterion(settings, first.noise, rigid=paths.parts is not None)
    model, evidence, curve, confidence = _those_that_are_there(first.model, first.evidence, criterion, settings.bodies)
    progress(_STAGE, 3, 3)
    evidence = replace(evidence, positions=positions)
    return _result(model, evidence, paths, first, curve, confidence)


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
                confidence = np.minimum(confidence, confidence_of(left.against))
            return model, evidence, curve, confidence


def _criterion(settings: MotionBodiesSettings, noise: SurfaceNoise, rigid: bool) -> Criterion:
    """When a body is one; rigid parts turn as a whole, and none that points suit on its own is a piece of soft skin."""
    softness = 0.0 if rigid else settings.soft_fraction
    return Criterion(settings.least_turn(rigid), noise, settings.min_fraction, softness)


def _result(
    model: BodyModel,
    evidence: Evidence,
    paths: MotionPaths,
    found_from: FirstBodies,
    curve: tuple[EliminationStep, ...],
    confidence: np.ndarray,
) -> MotionBodies:
    memberships, diagonal = model.memberships(), paths.diagonal
    miss = np.linalg.norm(sure_part(model.carry(evidence.rest) - evidence.positions, evidence.ray), axis=2)
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
        found_from.graph.lasting,
        found_from.graph.adjacency,
        curve,
        found_from.linkage,
        diagonal,
        float(np.median(evidence.unevenness)),
        confidence,
        float(np.sqrt(found_from.noise.variance)),
    )
