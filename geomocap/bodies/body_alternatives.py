"""What a body explains that the others can't, even if they move otherwise than they do beside it.

Beside a body its neighbours have the motion of what is left to them: the upper half of a thigh leaves the lower half to
another body, which turns half way to the shank, and trunk and half a thigh explain the other half badly. One thigh and
blends of it would explain both. Likelihoods of two models compare where each is as likely as it can be: so without the
body the neighbours choose their samples and their motions anew, and what they miss then of the body's samples, and more
of their own than before, is what the body explains. Where joints part less without it, that says nothing for either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_evidence import Candidate, fitted, gross, noise_of, observed, of_required, only_seen
from geomocap.bodies.body_joints import Borders, held_together, neighbours_of
from geomocap.bodies.body_model import BodyModel, Evidence, reassign, refit, settle_rest

_ROUNDS = 2


@dataclass(frozen=True)
class Alternative:
    """A model without one of its bodies.

    Attributes
    ----------
    evidence : float
        What it explains over what its freedoms cost; below 1 this model is the better one.
    model : BodyModel
        The same bodies, of which that one has no sample.
    known : Evidence
        With places in the reference settled anew.
    """

    evidence: float
    model: BodyModel
    known: Evidence


@dataclass(frozen=True)
class _Missed:
    """How the best blends of a model explain samples: mean squares of the misses, metres², and the blends."""

    squares: np.ndarray
    main: np.ndarray
    partner: np.ndarray
    fraction: np.ndarray


def best_alternative(candidate: Candidate, model: BodyModel, evidence: Evidence, criterion: Criterion) -> Alternative:
    """The likeliest model without a body: its samples go to blends of its neighbours, or all to that which turns alike.

    Parameters
    ----------
    candidate : Candidate
        The body, which touches others.
    model : BodyModel
    evidence : Evidence
    criterion : Criterion
    """
    ways = {-1, candidate.into}
    found = [without(replace(candidate, into=into), model, evidence, criterion) for into in sorted(ways)]
    return min(found, key=lambda alternative: alternative.evidence)


def without(candidate: Candidate, model: BodyModel, evidence: Evidence, criterion: Criterion) -> Alternative:
    """The model without a body whose samples go to blends of its neighbours, or to one, and what it explains."""
    body, borders = candidate.body, Borders.of(model, evidence)
    members = np.flatnonzero(model.label == body)
    neighbours = np.flatnonzero(neighbours_of(borders.contacts[body]))
    left, known = remove(candidate, model, evidence)
    takers = np.union1d(neighbours, left.label[members])
    asked = np.flatnonzero(np.isin(model.label, [body, *takers]))
    left = reassign(left, known, _ROUNDS, asked, takers)
    before, after = only_seen(evidence.with_places_open()), only_seen(known.with_places_open())
    adjacent = left.adjacent(known.adjacency)
    adjacent[np.ix_(neighbours, neighbours)] = True
    nats = max(held_together(body, neighbours, model, criterion, borders, left), 0.0)
    left_borders = Borders.of(left, known)
    changed = (left.rotations != model.rotations).any(axis=(1, 2, 3))
    for one in (body, *neighbours[changed[neighbours]].tolist()):
        some, _, observations = observed(np.flatnonzero(model.label == one), evidence, criterion)
        more = fitted(observations) if one == body else 1.0
        best = _missed(some, model, before, model.adjacent(before.adjacency), np.array([one]))
        other = _missed(some, left, after, adjacent, neighbours if one == body else np.array([], int))
        noise = noise_of(some, other.main, other.partner, other.fraction, left, after, criterion, left_borders)
        most = gross(noise, some, evidence, criterion)
        gain = np.log((noise + np.minimum(other.squares, most)) / (noise + np.minimum(more * best.squares, most)))
        if one == body:
            gain = np.maximum(gain, 0.0)
            own = observations
        nats += max(0.5 * observations * float(gain.mean()), 0.0)
    return Alternative(of_required(nats, own, members, evidence, criterion), left, known)


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


def _missed(some: np.ndarray, model: BodyModel, evidence: Evidence, adjacent: np.ndarray, also: np.ndarray) -> _Missed:
    """Explain some samples by the bodies near them and some others, and blends of those that are adjacent."""
    allowed = (evidence.near[some] @ np.eye(model.count)[model.label]) > 0
    allowed[:, also] = True
    found = evidence.explain(some, model, allowed, adjacent, 0.0)
    row, main = np.arange(len(some)), found.costs.argmin(axis=1)
    return _Missed(found.costs[row, main], main, found.partner[row, main], found.fraction[row, main])
