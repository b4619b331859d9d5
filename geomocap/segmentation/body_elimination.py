"""From too many bodies to those that are there: one after another goes that its neighbours explain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomocap.segmentation.body_model import BodyModel, Evidence, reassign, refit, settle_rest
from geomocap.segmentation.rigid_motions import relative_turn

_MOST_SAMPLES = 80
_MOST_NEIGHBOURS = 7
_CORE = 0.4
_CLEARLY = np.deg2rad(40.0)
_TIP_QUANTILE = 0.8
_TURN_SHARE = 0.02
_LEAST_SEEN = 0.1
_LEAST_FRAMES = 5
_FEIGNED = 1.0


@dataclass(frozen=True)
class Criterion:
    """When a body is one.

    Attributes
    ----------
    min_turn : float, radians
        It turns at least this much against each neighbour, and
    min_excess : float, radians
        blends of its neighbours miss its samples by at least this angle, seen from its middle.
    largest_radius : float, metres
        Radius of gyration from which on that angle is no longer counted smaller.
    """

    min_turn: float
    min_excess: float
    largest_radius: float


@dataclass(frozen=True)
class Candidate:
    """A body and what speaks for it.

    Attributes
    ----------
    body : int
    strength : float
        The smaller of turn and excess as a share of what is required; below 1 it is no body.
    into : int
        Neighbour that turns most alike; -1: its samples go to blends of the neighbours.
    turn, excess : float, radians
    """

    body: int
    strength: float
    into: int
    turn: float
    excess: float


@dataclass(frozen=True)
class EliminationStep:
    """One point of the elimination curve.

    Attributes
    ----------
    bodies : int
        Number of bodies before the step.
    strength : float
        Of the weakest of them: the criterion would have to be this many times itself for that body to go.
    turn_deg, excess_deg : float
        Of the weakest body.
    """

    bodies: int
    strength: float
    turn_deg: float
    excess_deg: float


def eliminate(
    model: BodyModel, evidence: Evidence, criterion: Criterion, count: int | None
) -> tuple[BodyModel, Evidence, list[EliminationStep]]:
    """Take away the weakest body until all are strong enough, or until a given number is left.

    Returns
    -------
    BodyModel
    Evidence
        With places in the reference settled anew.
    list of EliminationStep
        The curve; its last step is the one that was not taken.
    """
    curve: list[EliminationStep] = []
    known: dict[int, Candidate] = {}
    while True:
        bodies = np.unique(model.label).tolist()
        known = {b: known[b] if b in known else judge(b, model, evidence, criterion) for b in bodies}
        weakest = min(known.values(), key=lambda c: (c.strength, c.body))
        turn_deg, excess_deg = float(np.rad2deg(weakest.turn)), float(np.rad2deg(weakest.excess))
        curve.append(EliminationStep(len(bodies), weakest.strength, turn_deg, excess_deg))
        enough = weakest.strength >= 1.0 if count is None else len(bodies) <= count
        if enough or len(bodies) == 1 or not np.isfinite(weakest.strength):
            return model.compact(), evidence, curve
        before = model
        model, evidence = remove(weakest, model, evidence)
        for stale in _changed(before, model, evidence):
            known.pop(stale, None)


def _changed(before: BodyModel, after: BodyModel, evidence: Evidence) -> list[int]:
    """Bodies that have other samples or another motion than before, and those that touch them."""
    moved = before.label != after.label
    changed = (before.rotations != after.rotations).any(axis=(1, 2, 3))
    changed[before.label[moved]] = True
    changed[after.label[moved]] = True
    touching = (before.contacts(evidence.adjacency) + after.contacts(evidence.adjacency)) > 0
    return np.flatnonzero(changed | touching[changed].any(axis=0)).tolist()


def judge(body: int, model: BodyModel, evidence: Evidence, criterion: Criterion) -> Candidate:
    """What speaks for a body: how far it turns against its neighbours, and how badly these explain it."""
    neighbours = np.flatnonzero(model.adjacent(evidence.adjacency)[body])
    members = np.flatnonzero(model.label == body)
    if not len(neighbours) or not len(members):
        return Candidate(body, np.inf, -1, np.inf, np.inf)
    turns = [_turn(body, int(q), model, evidence) for q in neighbours]
    turn, into = min(zip(turns, neighbours.tolist(), strict=True))
    rest = evidence.rest[members]
    radius = min(float(np.sqrt(((rest - rest.mean(axis=0)) ** 2).sum(axis=1).mean())), criterion.largest_radius)
    if len(members) > _MOST_SAMPLES:
        members = members[np.linspace(0, len(members) - 1, _MOST_SAMPLES).astype(int)]
    reached = np.bincount(model.label[evidence.near[members].indices], minlength=model.count)
    reached[body] = 0
    reached[neighbours] += len(model.label)  # those that touch come first
    others = np.argsort(-reached, kind="stable")[: min(_MOST_NEIGHBOURS, int((reached > 0).sum()))]
    any_pair = np.ones((model.count, model.count), bool)
    without = np.zeros((len(members), model.count), bool)
    without[:, others] = True
    alone = np.zeros_like(without)
    alone[:, body] = True
    by_others = evidence.explain(members, model, without, any_pair, 0.0).costs.min(axis=1)
    by_itself = evidence.explain(members, model, alone, any_pair, 0.0).costs.min(axis=1)
    # the samples that are most clearly this body's own: it must have a core, not only a gradual change
    own = np.argsort(by_itself - by_others, kind="stable")[: max(5, int(_CORE * len(members)))]
    gain = by_others[own].mean() - by_itself[own].mean()
    # what the standard deviation of the positions could feign is no evidence
    sigma = float(np.sqrt((evidence.sigma[members] ** 2).mean()))
    excess = float(np.arctan2(np.sqrt(max(gain - (_FEIGNED * sigma) ** 2, 0.0)), max(radius, 1e-9)))
    turn = max(turn - float(np.arctan2(_FEIGNED * sigma, max(radius, 1e-9))), 0.0)
    by_turn, by_excess = turn / criterion.min_turn, excess / criterion.min_excess
    return Candidate(body, min(by_turn, by_excess), into if by_turn < by_excess else -1, turn, excess)


def _turn(first: int, second: int, model: BodyModel, evidence: Evidence) -> float:
    """Turn of two bodies against each other: mean of that of their motions and of their most different parts."""
    known = _seen(first, model, evidence) & _seen(second, model, evidence)
    if known.sum() < min(_LEAST_FRAMES, len(known)):
        known[:] = True
    one, other = model.rotations[first, known], model.rotations[second, known]
    if min(evidence.certain[model.label == body].sum() for body in (first, second)) < 3:
        # nothing ties the body to the reference: its turn counts from the middle of the frames
        at = len(one) // 2
        return relative_turn(one @ one[at].T, other @ other[at].T, _TURN_SHARE)
    turn = relative_turn(one, other, _TURN_SHARE)
    if turn > _CLEARLY:
        return turn
    a = np.flatnonzero((model.label == first) & model.core)
    b = np.flatnonzero((model.label == second) & model.core)
    if min(len(a), len(b)) < 4:
        return turn
    return 0.5 * (turn + float(np.quantile(evidence.turns[np.ix_(a, b)], _TIP_QUANTILE)))


def _seen(body: int, model: BodyModel, evidence: Evidence) -> np.ndarray:
    """Frames in which enough samples of a body are seen to know its motion, (T,) bool."""
    seen = evidence.seen[model.label == body]
    return seen.sum(axis=0) >= max(3, _LEAST_SEEN * len(seen))


def remove(candidate: Candidate, model: BodyModel, evidence: Evidence) -> tuple[BodyModel, Evidence]:
    """Take a body away: its samples go to the neighbour that turns alike, or to blends of the neighbours."""
    body = candidate.body
    gone = np.flatnonzero(model.label == body)
    label, partner, share = model.label.copy(), model.partner.copy(), model.share.copy()
    if candidate.into >= 0:
        label[gone], partner[gone], share[gone] = candidate.into, -1, 1.0
        affected = np.array([candidate.into])
    else:
        reached = np.bincount(model.label[evidence.near[gone].indices], minlength=model.count) > 0
        reached |= model.adjacent(evidence.adjacency)[body]
        reached[body] = False
        affected = np.flatnonzero(reached)
        allowed = np.zeros((len(gone), model.count), bool)
        allowed[:, affected] = True
        any_pair = np.ones((model.count, model.count), bool)
        blends = evidence.explain(gone, model, allowed, any_pair, evidence.penalty)
        rows = np.arange(len(gone))
        label[gone] = blends.costs.argmin(axis=1)
        partner[gone], share[gone] = blends.partner[rows, label[gone]], blends.share[rows, label[gone]]
    orphaned = partner == body
    partner[orphaned], share[orphaned] = -1, 1.0
    left = replace(model, label=label, partner=partner, share=share)
    evidence = settle_rest(left, evidence)
    return reassign(refit(left, evidence, affected), evidence, 1), evidence
