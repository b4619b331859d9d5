"""From too many bodies to those that are there: one after another goes that its neighbours explain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomocap.bodies.body_evidence import Candidate, Criterion, Turns, judge, neighbours_of
from geomocap.bodies.body_model import BodyModel, Evidence, reassign, refit, settle_rest

_FURTHER = 4  # steps beyond the criterion, as alternatives
_LEAST_BODIES = 2


@dataclass(frozen=True)
class EliminationStep:
    """One point of the elimination curve.

    Attributes
    ----------
    bodies : int
        Number of bodies before the step.
    strength : float
        Of the weakest of them: the criterion would have to be this many times itself for that body to go.
    turn_deg, evidence : float
        Of the weakest body, see `Candidate`.
    label : (N,) int32
        Body of each sample before the step.
    """

    bodies: int
    strength: float
    turn_deg: float
    evidence: float
    label: np.ndarray


@dataclass(frozen=True)
class Elimination:
    """The bodies that are left, and how it came to them.

    Attributes
    ----------
    model : BodyModel
    evidence : Evidence
        With places in the reference settled anew.
    curve : tuple of EliminationStep
        With a few steps beyond the criterion.
    """

    model: BodyModel
    evidence: Evidence
    curve: tuple[EliminationStep, ...]


def eliminate(model: BodyModel, evidence: Evidence, criterion: Criterion, count: int | None) -> Elimination:
    """Take away the weakest body until all are strong enough, or until a given number is left.

    Bodies are judged with places at rest of each sample's own: only motion is compared.
    """
    curve: list[EliminationStep] = []
    model, evidence = _weaken(model, evidence, criterion, count, curve)
    further = max(_LEAST_BODIES, len(np.unique(model.label)) - _FURTHER)
    _weaken(model, evidence, criterion, further, curve)
    return Elimination(model.compact(), evidence, tuple(curve))


def _weaken(
    model: BodyModel, evidence: Evidence, criterion: Criterion, count: int | None, curve: list[EliminationStep]
) -> tuple[BodyModel, Evidence]:
    """Take away the weakest body until `count` are left or, without one, all are strong."""
    known: dict[int, Candidate] = {}
    turns: Turns = {}
    while True:
        bodies = np.unique(model.label).tolist()
        new = (b for b in bodies if b not in known)
        known |= judge(new, model, evidence.with_places_open(), criterion, turns)
        weakest = min(known.values(), key=lambda c: (c.strength, c.body))
        if curve and curve[-1].bodies == len(bodies):  # judged anew
            curve.pop()
        label = np.unique(model.label, return_inverse=True)[1].astype(np.int32)
        turn_deg = float(np.rad2deg(weakest.turn))
        curve.append(EliminationStep(len(bodies), weakest.strength, turn_deg, weakest.evidence, label))
        enough = weakest.strength >= 1.0 if count is None else len(bodies) <= count
        if enough or len(bodies) == 1 or not np.isfinite(weakest.strength):
            return model, evidence
        before = model
        model, evidence = remove(weakest, model, evidence)
        stale, turned = _changed(before, model, evidence)
        known = {b: candidate for b, candidate in known.items() if not stale[b]}
        turns = {pair: turn for pair, turn in turns.items() if not turned[list(pair)].any()}


def confidences(model: BodyModel, evidence: Evidence, criterion: Criterion) -> np.ndarray:
    """How sure it is that each body is one, (B,) float, 0 to 1, see `Candidate`."""
    judged = judge(range(model.count), model, evidence.with_places_open(), criterion)
    return np.array([judged[b].confidence for b in range(model.count)])


def _changed(before: BodyModel, after: BodyModel, evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """Bodies to judge anew, and those of which turns are to be found anew, (B,) bool each.

    The first have other samples or another motion than before, or touch such; of the others turns are known still, but
    where samples that blended with the one that went follow them alone now.
    """
    moved = before.label != after.label
    changed = (before.rotations != after.rotations).any(axis=(1, 2, 3))
    changed[before.label[moved]] = True
    changed[after.label[moved]] = True
    turned = changed.copy()
    turned[after.label[before.core != after.core]] = True
    touching = (before.contacts(evidence.adjacency) + after.contacts(evidence.adjacency)) > 0
    return changed | touching[changed].any(axis=0), turned


def remove(candidate: Candidate, model: BodyModel, evidence: Evidence) -> tuple[BodyModel, Evidence]:
    """Take a body away: its samples go to the neighbour that turns alike, or to blends of the neighbours.

    All others stay, for the borders of the first grouping are truer than those of samples that choose anew, which drift
    on soft skin. Where single cameras follow the surface all choose anew, as each body puts them at another depth.
    """
    body = candidate.body
    gone = np.flatnonzero(model.label == body)
    label, partner, fraction = model.label.copy(), model.partner.copy(), model.fraction.copy()
    if candidate.into >= 0:
        label[gone], partner[gone], fraction[gone] = candidate.into, -1, 1.0
        affected = np.array([candidate.into])
    else:
        reached = np.bincount(model.label[evidence.near[gone].indices], minlength=model.count) > 0
        reached |= neighbours_of(model.contacts(evidence.adjacency)[body])
        reached[body] = False
        affected = np.flatnonzero(reached)
        allowed = np.zeros((len(gone), model.count), bool)
        allowed[:, affected] = True
        any_pair = np.ones((model.count, model.count), bool)
        blends = evidence.explain(gone, model, allowed, any_pair, evidence.penalty)
        rows = np.arange(len(gone))
        label[gone] = blends.costs.argmin(axis=1)
        partner[gone], fraction[gone] = blends.partner[rows, label[gone]], blends.fraction[rows, label[gone]]
    orphaned = partner == body
    partner[orphaned], fraction[orphaned] = -1, 1.0
    left = replace(model, label=label, partner=partner, fraction=fraction)
    evidence = settle_rest(left, evidence)
    left = refit(left, evidence, affected)
    return (left if evidence.ray is None else reassign(left, evidence, 1)), evidence
