"""Where bodies touch, and how well joints hold them together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_model import BodyModel, Evidence

_OF_A_JOINT = 3  # directions in which it holds two bodies together
_NO_EDGE = 1e-9  # what a joint costs at least: 0 would be no edge of the tree
_LEAST_CONTACTS = 3
_LEAST_SEEN = 0.1
_LEAST_SAMPLES = 3  # that tell a motion
_LEAST_FRAMES = 5


@dataclass(frozen=True)
class Borders:
    """Where bodies touch.

    Attributes
    ----------
    contacts : (B, B) int
        Neighbouring pairs of samples of each two bodies.
    places : (B, B, 3) float, metres
        Middle of these, of different bodies; without meaning where they don't touch.
    """

    contacts: np.ndarray
    places: np.ndarray

    @classmethod
    def of(cls, model: BodyModel, evidence: Evidence) -> Borders:
        """Find where the bodies of a model touch."""
        contacts = model.contacts(evidence.adjacency)
        rows, columns = evidence.adjacency.nonzero()
        pair = model.count * model.label[rows] + model.label[columns]
        middle = 0.5 * (evidence.rest[rows] + evidence.rest[columns])
        sums = np.stack([np.bincount(pair, along, model.count**2) for along in middle.T], axis=1)
        return cls(contacts, sums.reshape(*contacts.shape, 3) / np.maximum(contacts, 1)[..., None])


def neighbours_of(touching: np.ndarray) -> np.ndarray:
    """Which bodies are neighbours of one that touches each of them in so many places, (B,) int: (B,) bool.

    Few samples may touch others in few places: those that it touches most are its neighbours then.
    """
    return touching >= max(min(_LEAST_CONTACTS, touching.max()), 1)


def held_together(
    body: int,
    neighbours: np.ndarray,
    model: BodyModel,
    evidence: Evidence,
    criterion: Criterion,
    borders: Borders,
    without: BodyModel | None = None,
) -> float:
    """Log likelihood that a body adds to that of the joints of its neighbours, in nats: 0 with one neighbour.

    Joints are those of the tree that parts least. Without the body its neighbours meet where they touch each other, or
    where they touched the body, which hangs on one of them; `without` is how they move then, as with it if not given.
    """
    bodies = [body, *neighbours.tolist()]
    together = _joint_costs(bodies, body, model, evidence, criterion, borders)
    alone = together[1:, 1:]
    if without is not None:
        alone = _joint_costs(bodies[1:], body, without, evidence, criterion, borders)
    nats = minimum_spanning_tree(alone).sum() + together[1:, 0].min() - minimum_spanning_tree(together).sum()
    return 0.5 * _OF_A_JOINT * float(nats)


def _joint_costs(
    bodies: list[int], body: int, model: BodyModel, evidence: Evidence, criterion: Criterion, borders: Borders
) -> np.ndarray:
    """Log of how far the bodies part where they touch each other or a given one: lower triangle of (n, n)."""
    costs = np.zeros((len(bodies), len(bodies)))
    for i in range(1, len(bodies)):
        for k in range(i):
            pair = bodies[i], bodies[k]
            places = [borders.places[pair]] if borders.contacts[pair] else []
            if body not in pair:
                places += [borders.places[body, one] for one in pair]
            miss = min(parted(*pair, place, model, evidence, criterion) for place in places)
            costs[i, k] = math.log1p(miss / criterion.noise.variance) + _NO_EDGE
    return costs


def parted(
    first: int, second: int, place: np.ndarray, model: BodyModel, evidence: Evidence, criterion: Criterion
) -> float:
    """Mean square by which two bodies' motions carry their best common point near a place (3,) apart, metres²."""
    return float((parting(first, second, place, model, evidence, criterion) ** 2).sum(axis=1).mean())


def parting(
    first: int, second: int, place: np.ndarray, model: BodyModel, evidence: Evidence, criterion: Criterion
) -> np.ndarray:
    """How two bodies' motions carry their best common point near a place (3,) apart, (K, 3), metres.

    In the frames that show both. A point off the place costs as much as if the least turn of a body moved it.
    """
    known = shown(first, second, model, evidence)
    turned = model.rotations[first, known] - model.rotations[second, known]
    apart = turned @ place + model.translations[first, known] - model.translations[second, known]
    normal = np.einsum("tji,tjk->ik", turned, turned) / len(turned) + criterion.min_turn**2 * np.eye(3)
    moved = -np.linalg.solve(normal, np.einsum("tji,tj->i", turned, apart) / len(turned))
    result: np.ndarray = turned @ moved + apart
    return result


def shown(first: int, second: int, model: BodyModel, evidence: Evidence) -> np.ndarray:
    """Frames that show both of two bodies, (T,) bool; all where these are too few."""
    known = _seen(first, model, evidence) & _seen(second, model, evidence)
    if known.sum() < min(_LEAST_FRAMES, len(known)):
        known[:] = True
    return known


def _seen(body: int, model: BodyModel, evidence: Evidence) -> np.ndarray:
    """Frames in which enough samples of a body are seen to know its motion, (T,) bool."""
    return motion_known(evidence.seen[model.label == body])


def motion_known(seen: np.ndarray) -> np.ndarray:
    """Frames in which enough of a body's samples are seen, (n, T) bool, to know its motion: (T,) bool."""
    enough: np.ndarray = seen.sum(axis=0) >= max(_LEAST_SAMPLES, _LEAST_SEEN * len(seen))
    return enough
