"""From too many bodies to those that are there: one after another goes that its neighbours explain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.bodies.body_alternatives import best_alternative, remove
from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_evidence import Candidate, Turns, judge
from geomocap.bodies.body_model import BodyModel, Evidence

_FURTHER = 4  # steps beyond the criterion, as alternatives
_LEAST_BODIES = 2
# With so many times what is required, bodies are not asked what the best model without them is worth: without a blade
# of a fan, a fragment at its border took its place, and the blade went instead of it.
_SURE = 2.5


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
    against : (B,) float
        What each body explains that the others can't however they move, over what its freedoms cost; infinite where
        that wasn't asked: it is sure beside them.
    """

    model: BodyModel
    evidence: Evidence
    curve: tuple[EliminationStep, ...]
    against: np.ndarray


def eliminate(model: BodyModel, evidence: Evidence, criterion: Criterion, count: int | None) -> Elimination:
    """Take away the weakest body until all are strong enough, or until a given number is left.

    Bodies are judged with places at rest of each sample's own: only motion is compared. Beside the others as they move
    first; those that are left then against the best model without them. Where single cameras follow the surface that
    isn't asked: depths are found from the bodies there, and nearly any bodies explain nearly any motion. (A person on a
    treadmill, four cameras, five choices of the paths: 112 mm from the markers without asking, 129 with it.)
    """
    curve: list[EliminationStep] = []
    against: dict[int, float] = {}
    model, evidence = _weaken(model, evidence, criterion, count, curve)
    if count is None and evidence.ray is None:
        model, evidence, against = _defended(model, evidence, criterion, curve)
    bodies = np.unique(model.label).tolist()
    _weaken(model, evidence, criterion, max(_LEAST_BODIES, len(bodies) - _FURTHER), curve)
    return Elimination(model.compact(), evidence, tuple(curve), np.array([against.get(b, np.inf) for b in bodies]))


def _defended(
    model: BodyModel, evidence: Evidence, criterion: Criterion, curve: list[EliminationStep]
) -> tuple[BodyModel, Evidence, dict[int, float]]:
    """Take away the body that the best model without it needs least, until each is needed; what each is worth then."""
    worth: dict[int, float] = {}
    while True:
        judged = judge(np.unique(model.label).tolist(), model, evidence.with_places_open(), criterion)
        asked = [b for b in judged if b not in worth and judged[b].strength < _SURE]
        worth |= {b: best_alternative(judged[b], model, evidence, criterion).evidence for b in asked}
        weakest = min(worth, key=lambda b: (worth[b], b), default=-1)
        if weakest < 0 or worth[weakest] >= 1.0 or len(judged) <= _LEAST_BODIES:
            return model, evidence, worth
        before = model
        curve[-1] = _step(model, judged[weakest], worth[weakest])
        best = best_alternative(judged[weakest], model, evidence, criterion)  # others may have gone since
        model, evidence = _weaken(best.model, best.known, criterion, None, curve)
        stale, _ = _changed(before, model, evidence)
        left = np.unique(model.label)
        worth = {b: value for b, value in worth.items() if b in left and not stale[b]}


def _step(model: BodyModel, weakest: Candidate, strength: float) -> EliminationStep:
    bodies, label = np.unique(model.label, return_inverse=True)
    turn_deg = float(np.rad2deg(weakest.turn))
    return EliminationStep(len(bodies), strength, turn_deg, weakest.evidence, label.astype(np.int32))


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
        curve.append(_step(model, weakest, weakest.strength))
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
