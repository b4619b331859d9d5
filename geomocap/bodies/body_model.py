"""Bodies that move rigidly, and how samples follow one of them or a blend of two."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from geomocap.bodies.rigid_motions import fit_rigid_motion
from geomocap.bodies.skin_blending import Blends, explain, places_at_rest

_LEAST_CONTACTS = 3
_LEAST_FRACTION = 0.3
_CORE_FRACTION = 0.85
_STEADY = 0.002
_BY_ONE = 2 / 3  # that a sample counts where one camera alone sees it


@dataclass(frozen=True)
class Evidence:
    """What is known of N samples.

    Attributes
    ----------
    positions : (N, T, 3) float, metres
        Complete.
    weights : (N, T) float
        0 where not seen (filled by neighbours).
    seen : (N, T) bool
    sigma : (N,) float, metres
        Standard deviation of the positions as their source states it; 0: not stated.
    ray : (N, T, 3) float, optional
        Directions along which positions are unsure, see `MotionPaths`.
    rest : (N, 3) float, metres
        Positions in the reference.
    certain : (N,) bool
        Samples whose place in the reference, frame 0, was seen and is sure; that of others is found by their body.
    turns : (N, N) float32, radians
        How differently two samples turn.
    unevenness : (N,) float, radians
        How differently from its neighbours a sample turns, their median: mostly how unsure that is.
    adjacency : (N, N) csr_matrix
        Neighbours on the surface.
    near : (N, N) csr_matrix
        1 where samples are near along the surface: a sample may follow the bodies of those.
    penalty : float, metres
        Blends of two bodies count as a residual of this, at equal parts; infinite: there are no blends.
    cap : float, metres
        Larger residuals count as this.
    noise : float, metres
        Residuals below this are all the same.
    smoothness : float
        Weight of the neighbours' costs in the choice of a sample's body, 0 to 1.
    """

    positions: np.ndarray
    weights: np.ndarray
    seen: np.ndarray
    sigma: np.ndarray
    ray: np.ndarray | None
    rest: np.ndarray
    certain: np.ndarray
    turns: np.ndarray
    unevenness: np.ndarray
    adjacency: csr_matrix
    near: csr_matrix
    penalty: float
    cap: float
    noise: float
    smoothness: float

    @cached_property
    def lone(self) -> np.ndarray:
        """Where one camera alone sees a sample, (N, T) bool."""
        return np.zeros(self.seen.shape, bool) if self.ray is None else (self.ray != 0).any(axis=2)

    @cached_property
    def counts(self) -> np.ndarray:
        """What each sample counts in the size of a body, (N,) float: less where one camera alone sees it."""
        if self.ray is None:
            return np.ones(len(self.rest))
        alone = (self.lone & self.seen).sum(axis=1) / np.maximum(self.seen.sum(axis=1), 1)
        return 1.0 - (1.0 - _BY_ONE) * alone

    def with_places_open(self) -> Evidence:
        """The same, no place in the reference being sure: each body may put a sample where it fits best."""
        return replace(self, certain=np.zeros(len(self.rest), bool))

    def explain(
        self, samples: np.ndarray, model: BodyModel, allowed: np.ndarray, adjacent: np.ndarray, penalty: float
    ) -> Blends:
        """Explain some samples by allowed bodies, (n, B) bool, and blends of some with some, (B, B) bool."""
        return explain(
            samples,
            self.positions,
            self.weights,
            self.ray,
            self.rest,
            self.certain,
            model.rotations,
            model.translations,
            allowed,
            adjacent & np.isfinite(self.penalty),
            penalty,
            self.cap,
        )


@dataclass(frozen=True)
class BodyModel:
    """B bodies and what the samples follow.

    Attributes
    ----------
    label : (N,) int
        Main body of each sample.
    partner : (N,) int
        Second body of a blend; -1: none.
    fraction : (N,) float
        Weight of the main body, 0.5 to 1.
    rotations, translations : (B, T, 3, 3), (B, T, 3) float
        Motion of each body: position = rotation @ rest + translation.
    """

    label: np.ndarray
    partner: np.ndarray
    fraction: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray

    @property
    def count(self) -> int:
        """Number of bodies B."""
        return len(self.rotations)

    @property
    def core(self) -> np.ndarray:
        """Samples that follow their body nearly alone, (N,) bool."""
        return self.fraction > _CORE_FRACTION

    def contacts(self, adjacency: csr_matrix) -> np.ndarray:
        """Neighbouring pairs of samples between each two bodies, (B, B) int; the diagonal is 0."""
        rows, columns = adjacency.nonzero()
        pair = self.count * self.label[rows] + self.label[columns]
        result = np.bincount(pair, minlength=self.count**2).reshape(self.count, self.count)
        np.fill_diagonal(result, 0)
        return result

    def adjacent(self, adjacency: csr_matrix) -> np.ndarray:
        """Which bodies touch, (B, B) bool."""
        return self.contacts(adjacency) >= _LEAST_CONTACTS

    def memberships(self) -> np.ndarray:
        """Weights of all bodies for each sample, (N, B) float; rows sum to 1."""
        result = np.zeros((len(self.label), self.count))
        rows = np.arange(len(self.label))
        result[rows, self.label] = self.fraction
        blended = self.partner >= 0
        result[rows[blended], self.partner[blended]] += 1.0 - self.fraction[blended]
        result[rows[~blended], self.label[~blended]] = 1.0
        return result

    def carry(self, rest: np.ndarray) -> np.ndarray:
        """Samples (N, 3), metres, carried by what they follow: (N, T, 3)."""
        memberships = self.memberships()
        carried = np.zeros((len(rest), self.rotations.shape[1], 3))
        for b in range(self.count):
            some = np.flatnonzero(memberships[:, b] > 0)
            moved = carry(self.rotations[b], self.translations[b], rest[some])
            carried[some] += memberships[some, b][:, None, None] * moved
        return carried

    def compact(self) -> BodyModel:
        """Leave out bodies without samples."""
        used, label = np.unique(self.label, return_inverse=True)
        if len(used) == self.count:
            return self
        renumbered = np.full(self.count + 1, -1)
        renumbered[used] = np.arange(len(used))
        partner = renumbered[self.partner]
        fraction = np.where(partner < 0, 1.0, self.fraction)
        return BodyModel(label, partner, fraction, self.rotations[used], self.translations[used])


def model_of_labels(label: np.ndarray, evidence: Evidence) -> BodyModel:
    """Fit rigid motions to groups of samples, without blends."""
    count, frames = int(label.max()) + 1, evidence.positions.shape[1]
    rotations = np.tile(np.eye(3), (count, frames, 1, 1))
    whole = BodyModel(label, np.full(len(label), -1), np.ones(len(label)), rotations, np.zeros((count, frames, 3)))
    return refit(whole, evidence, np.arange(count))


def refit(model: BodyModel, evidence: Evidence, bodies: np.ndarray) -> BodyModel:
    """Fit the motions of some bodies anew.

    A sample of weight w for body b and 1 - w for another says of b: (position - (1 - w) carried by the other) / w, with
    weight w². So the soft samples tell how far a body turns too, instead of pulling its motion towards its neighbours'.
    """
    rotations, translations = model.rotations.copy(), model.translations.copy()
    for b in bodies:
        mine = np.flatnonzero(model.label == b)
        if not len(mine):
            continue
        shared = np.flatnonzero((model.partner == b) & (1.0 - model.fraction > _LEAST_FRACTION))
        members = np.concatenate([mine, shared])
        part = np.concatenate([model.fraction[mine], 1.0 - model.fraction[shared]])
        other = np.concatenate([model.partner[mine], model.label[shared]])
        seen = evidence.positions[members]
        rest = evidence.rest[members]
        for q in np.unique(other[(other >= 0) & (part < 1.0)]):
            of = np.flatnonzero((other == q) & (part < 1.0))
            w = part[of][:, None, None]
            carried = carry(rotations[q], translations[q], rest[of])
            seen[of] = (seen[of] - (1.0 - w) * carried) / w
        weights = evidence.weights[members] * (part**2)[:, None]
        rotations[b], translations[b], _ = fit_rigid_motion(
            seen, rest, weights, evidence.noise, ray=None if evidence.ray is None else evidence.ray[members]
        )
    return replace(model, rotations=rotations, translations=translations)


def settle_rest(model: BodyModel, evidence: Evidence) -> Evidence:
    """Find where samples that were not seen in the reference are there, by their body.

    The place is that which the main body's motion carries best to the positions of all frames, least squares.
    """
    open_places = np.flatnonzero(~evidence.certain)
    if not len(open_places):
        return evidence
    rest = evidence.rest.copy()
    rest[open_places] = places_at_rest(
        open_places,
        model.label,
        evidence.positions,
        evidence.weights,
        evidence.ray,
        model.rotations,
        model.translations,
    )
    return replace(evidence, rest=rest)


def carry(rotations: np.ndarray, translations: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Points (n, 3) carried by one body's motion (T, 3, 3), (T, 3): (n, T, 3)."""
    return (rest @ rotations.transpose(0, 2, 1) + translations[:, None]).swapaxes(0, 1)


def reassign(
    model: BodyModel,
    evidence: Evidence,
    rounds: int,
    samples: np.ndarray | None = None,
    bodies: np.ndarray | None = None,
) -> BodyModel:
    """Let each sample follow what explains it and its neighbours best among the bodies near it; fit; repeat.

    Parameters
    ----------
    model : BodyModel
    evidence : Evidence
    rounds : int
        At most; fewer where hardly a sample moves.
    samples : (n,) int, optional
        Those that choose; all.
    bodies : (m,) int, optional
        Those that they may choose; all.
    """
    samples = np.arange(len(model.label)) if samples is None else samples
    near, average = evidence.near[samples], _average_of_neighbours(evidence.adjacency[samples][:, samples])
    open_bodies = np.ones(model.count, bool) if bodies is None else np.isin(np.arange(model.count), bodies)
    keep, row = 1.0 - evidence.smoothness, np.arange(len(samples))
    for _ in range(rounds):
        one = np.eye(model.count)[model.label]
        allowed = ((near @ one) > 0) & open_bodies
        before = model.label[samples], model.partner[samples], model.fraction[samples]
        allowed[row, before[0]] |= ~allowed.any(axis=1)
        blends = evidence.explain(samples, model, allowed, model.adjacent(evidence.adjacency), evidence.penalty)
        costs = np.minimum(blends.costs, evidence.cap**2)
        costs = keep * costs + evidence.smoothness * (average @ costs)
        costs[~allowed] = np.inf
        chosen = costs.argmin(axis=1)
        now = chosen, blends.partner[row, chosen], blends.fraction[row, chosen]
        moved = now[0] != before[0]
        changed = moved | (np.abs(now[2] - before[2]) > 0.02) | (now[1] != before[1])
        affected = np.unique(np.concatenate([before[0][changed], chosen[changed]]))
        label, partner, fraction = model.label.copy(), model.partner.copy(), model.fraction.copy()
        label[samples], partner[samples], fraction[samples] = now
        model = refit(replace(model, label=label, partner=partner, fraction=fraction), evidence, affected)
        if moved.mean() < _STEADY:
            break
    return model


def _average_of_neighbours(adjacency: csr_matrix) -> csr_matrix:
    linked = (adjacency > 0).astype(float)
    return linked.multiply(1.0 / np.maximum(np.asarray(linked.sum(axis=1)), 1.0)).tocsr()
