"""Where bodies touch, and how well joints hold them together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_model import BodyModel, Evidence
from geomocap.bodies.joint_kernel import frames_of, joint_costs, parting_of, tree_cost

_OF_A_JOINT = 3  # directions in which it holds two bodies together
_DIGITS = 9  # of nats: which joints are summed first is no evidence
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
    known : (B, T) bool
        Frames in which enough samples of a body are seen to know its motion.
    """

    contacts: np.ndarray
    places: np.ndarray
    known: np.ndarray

    @classmethod
    def of(cls, model: BodyModel, evidence: Evidence) -> Borders:
        """Find where the bodies of a model touch."""
        contacts = model.contacts(evidence.adjacency)
        rows, columns = evidence.adjacency.nonzero()
        pair = model.count * model.label[rows] + model.label[columns]
        middle = 0.5 * (evidence.rest[rows] + evidence.rest[columns])
        sums = np.stack([np.bincount(pair, along, model.count**2) for along in middle.T], axis=1)
        known = np.stack([motion_known(evidence.seen[model.label == body]) for body in range(model.count)])
        return cls(contacts, sums.reshape(*contacts.shape, 3) / np.maximum(contacts, 1)[..., None], known)

    def shown(self, first: int, second: int) -> np.ndarray:
        """Frames that show both of two bodies, (K,) int; all where these are too few."""
        frames = np.empty(self.known.shape[1], np.int64)
        return frames[: frames_of(self.known, first, second, _LEAST_FRAMES, frames)]


def neighbours_of(touching: np.ndarray) -> np.ndarray:
    """Which bodies are neighbours of one that touches each of them in so many places, (B,) int: (B,) bool.

    Few samples may touch others in few places: those that it touches most are its neighbours then.
    """
    return touching >= max(min(_LEAST_CONTACTS, touching.max()), 1)


def held_together(
    body: int,
    neighbours: np.ndarray,
    model: BodyModel,
    criterion: Criterion,
    borders: Borders,
    without: BodyModel | None = None,
) -> float:
    """Log likelihood that a body adds to that of the joints of its neighbours, in nats: 0 with one neighbour.

    Joints are those of the tree that parts least. Without the body its neighbours meet where they touch each other, or
    where they touched the body, which hangs on one of them; `without` is how they move then, as with it if not given.
    """
    bodies = np.array([body, *neighbours.tolist()])
    together = _joint_costs(bodies, body, model, criterion, borders)
    alone = together[1:, 1:].copy() if without is None else _joint_costs(bodies[1:], body, without, criterion, borders)
    nats = 0.5 * _OF_A_JOINT * (tree_cost(alone) + together[1:, 0].min() - tree_cost(together))
    return round(float(nats), _DIGITS)


def _joint_costs(bodies: np.ndarray, body: int, model: BodyModel, criterion: Criterion, borders: Borders) -> np.ndarray:
    """Log of how far the bodies part where they touch each other or a given one: (n, n)."""
    costs: np.ndarray = joint_costs(
        bodies,
        body,
        model.rotations,
        model.translations,
        borders.known,
        borders.contacts,
        borders.places,
        criterion.min_turn**2,
        criterion.noise.variance,
        _LEAST_FRAMES,
    )
    return costs


def parted(
    first: int, second: int, place: np.ndarray, model: BodyModel, criterion: Criterion, borders: Borders
) -> float:
    """Mean square by which two bodies' motions carry their best common point near a place (3,) apart, metres²."""
    return float((parting(first, second, place, model, criterion, borders) ** 2).sum(axis=1).mean())


def parting(
    first: int, second: int, place: np.ndarray, model: BodyModel, criterion: Criterion, borders: Borders
) -> np.ndarray:
    """How two bodies' motions carry their best common point near a place (3,) apart, (K, 3), metres.

    In the frames that show both. A point off the place costs as much as if the least turn of a body moved it.
    """
    frames = borders.shown(first, second)
    apart, ridge = np.empty((len(frames), 3)), criterion.min_turn**2
    parting_of(model.rotations, model.translations, first, second, frames, place, ridge, apart)
    return apart


def motion_known(seen: np.ndarray) -> np.ndarray:
    """Frames in which enough of a body's samples are seen, (n, T) bool, to know its motion: (T,) bool."""
    enough: np.ndarray = seen.sum(axis=0) >= max(_LEAST_SAMPLES, _LEAST_SEEN * len(seen))
    return enough
