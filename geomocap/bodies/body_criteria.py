"""When a body is one: it turns against its neighbours, blends of these do not explain it, and it is no soft skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from geomocap.bodies.body_model import BodyModel, Evidence
from geomocap.bodies.rigid_motions import relative_turn

_MOST_SAMPLES = 80
_MOST_NEIGHBOURS = 7
_CORE = 0.4
_CLEARLY = np.deg2rad(40.0)
_TIP_QUANTILE = 0.8
_UNEVEN = np.deg2rad(10.0)  # samples side by side that turn more differently are unsure
_TURN_FRACTION = 0.02
_LEAST_SEEN = 0.1
_LEAST_FRAMES = 5
_FEIGNED = 1.0
_LEAST_CONTACTS = 3
_ALSO_TOUCHES = 0.5  # a neighbour hangs on another body as well if its border with that is at least this long
_SOFT_EXCESS = np.deg2rad(12.0)  # what blends miss by more than this is no soft skin, whatever its turn
_LEAF_EXCESS = np.deg2rad(6.0)
_SOFT_FLOOR = np.deg2rad(1.0)
_QUANTILE = 0.95
_REACH = 0.95  # fraction of a body's samples within the reach of its joints
_SHIFT = 0.4  # a body may come apart from a joint by this, because of noise and softness (largest radii)
_SMALL = 1.5  # times what other bodies need
_HUB = 4  # so many neighbours: a trunk, whose turn may well be a small part of a limb's


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
    min_fraction : float
        It has at least this fraction of the samples.
    soft_fraction : float
        It is soft skin between two bodies if it turns by a fixed part of their turn, to within this fraction of it.
    """

    min_turn: float
    min_excess: float
    largest_radius: float
    min_fraction: float = 0.0
    soft_fraction: float = 0.18


@dataclass(frozen=True)
class Candidate:
    """A body and what speaks for it.

    Attributes
    ----------
    body : int
    strength : float
        The least of what speaks for it, as a fraction of what is required; below 1 it is no body.
    into : int
        Neighbour that turns most alike; -1: its samples go to blends of the neighbours.
    turn, excess : float, radians
    """

    body: int
    strength: float
    into: int
    turn: float
    excess: float


def judge(body: int, model: BodyModel, evidence: Evidence, criterion: Criterion) -> Candidate:
    """What speaks for a body: how far it turns against neighbours that hold it, and how badly neighbours explain it."""
    neighbours = np.flatnonzero(model.adjacent(evidence.adjacency)[body])
    members = np.flatnonzero(model.label == body)
    if not len(neighbours) or not len(members):
        return Candidate(body, np.inf, -1, np.inf, np.inf)
    rest, slack = evidence.rest[members], _SHIFT * criterion.largest_radius
    motion = model.rotations[body], model.translations[body]
    beside = [(model.rotations[q], model.translations[q]) for q in neighbours]
    joined = np.array([may_be_joined(rest, motion, other, slack) for other in beside])
    against = neighbours[joined] if joined.any() else neighbours
    turns = [_turn(body, int(q), model, evidence) for q in against]
    turn, into = min(zip(turns, against.tolist(), strict=True))
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


def may_be_joined(
    rest: np.ndarray, motion: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray], slack: float
) -> bool:
    """Whether a joint in its reach may hold a body to another one.

    A joint that a body reaches shifts its middle by no more than the turn at that distance. A hand at a hip may well
    turn like the thigh for a while, but it goes elsewhere.

    Parameters
    ----------
    rest : (n, 3) float, metres
        Samples of the body.
    motion, other : pairs of (T, 3, 3) float and (T, 3) float, metres
        Rotations and translations of the body and of the other one.
    slack : float, metres
        By which the body may come apart from the joint.
    """
    middle = rest.mean(axis=0)
    reach = float(np.quantile(np.linalg.norm(rest - middle, axis=1), _REACH))
    turned, moved = motion[0] - other[0], motion[1] - other[1]
    shift = np.linalg.norm(turned @ middle + moved, axis=1)
    # ‖R − Q‖ = √8 sin(a/2) for a turn by a between the two, which carries what is at distance r by 2 sin(a/2) r
    allowed = np.linalg.norm(turned, axis=(1, 2)) / np.sqrt(2.0) * reach
    return float(np.quantile(shift - allowed, _QUANTILE)) < slack


def _turn(first: int, second: int, model: BodyModel, evidence: Evidence) -> float:
    """Turn of two bodies against each other: mean of that of their motions and of their most different parts.

    Where samples side by side turn so differently that they are unsure, that of the motions counts more.
    """
    known = _seen(first, model, evidence) & _seen(second, model, evidence)
    if known.sum() < min(_LEAST_FRAMES, len(known)):
        known[:] = True
    one, other = model.rotations[first, known], model.rotations[second, known]
    if min(evidence.seen[model.label == body, 0].sum() for body in (first, second)) < 3:
        # nothing ties the body to frame 0: its turn counts from the middle of the frames
        at = len(one) // 2
        return relative_turn(one @ one[at].T, other @ other[at].T, _TURN_FRACTION)
    turn = relative_turn(one, other, _TURN_FRACTION)
    if turn > _CLEARLY:
        return turn
    a = np.flatnonzero((model.label == first) & model.core)
    b = np.flatnonzero((model.label == second) & model.core)
    if min(len(a), len(b)) < 4:
        return turn
    tips = float(np.quantile(evidence.turns[np.ix_(a, b)], _TIP_QUANTILE))
    uneven = np.sqrt(np.mean([np.median(evidence.unevenness[some]) ** 2 for some in (a, b)]))
    fraction = 0.5 * min(1.0, (_UNEVEN / max(float(uneven), 1e-9)) ** 2)
    return (1.0 - fraction) * turn + fraction * tips


def _seen(body: int, model: BodyModel, evidence: Evidence) -> np.ndarray:
    """Frames in which enough samples of a body are seen to know its motion, (T,) bool."""
    seen = evidence.seen[model.label == body]
    return seen.sum(axis=0) >= max(3, _LEAST_SEEN * len(seen))


def judge_softness(body: int, model: BodyModel, evidence: Evidence, criterion: Criterion) -> Candidate:
    """What speaks for a body once there are not too many: as `judge`, and that it is neither soft skin nor too small.

    Skin between two bodies follows both. Where it is deep, as on a thigh, no two of its samples follow them in the same
    way, and parts of it look like bodies that turn by ten or twenty degrees each. But such a part turns by a fixed
    fraction of the turn of the bodies beside it whatever they do; a body of its own does not. A trunk between two limbs
    is no skin, even if it turns by half of what they turn: other bodies hang on it that do not touch these limbs. And
    a body that touches four others or more is held to how near it is to a half: in step with the arms, a chest
    turns by a small part of what they turn.

    A body of too few samples goes, unless others hang together by it alone, as foot and trunk do by a leg that few
    samples are on; it must be stronger by as much as it is too small, and half again.
    """
    found = judge(body, model, evidence, criterion)
    if not np.isfinite(found.strength):
        return found
    contacts = model.contacts(evidence.adjacency)
    neighbours = np.flatnonzero(contacts[body] >= _LEAST_CONTACTS)
    fraction = float(evidence.counts[model.label == body].sum() / len(model.label))
    if fraction < criterion.min_fraction:
        size = fraction / criterion.min_fraction
        if not _connects(body, neighbours, contacts):
            turns = [_turn(body, int(q), model, evidence) for q in neighbours]
            into = int(neighbours[np.argmin(turns)])
            return Candidate(body, 0.5 * size, into, found.turn, found.excess)
        found = replace(found, strength=size * found.strength / _SMALL)
    softness, at_end = _between_two(body, neighbours, contacts, model, evidence, criterion)
    if np.isfinite(softness):
        strength = max(softness, found.excess / _SOFT_EXCESS)
    elif at_end or len(neighbours) == 1:
        strength = found.excess / _LEAF_EXCESS
    else:
        return found
    return Candidate(body, strength, -1, found.turn, found.excess) if strength < found.strength else found


def _connects(body: int, neighbours: np.ndarray, contacts: np.ndarray) -> bool:
    """Whether the bodies beside it hang together by this one only."""
    touching = contacts >= _LEAST_CONTACTS
    touching[body] = touching[:, body] = False
    part = connected_components(csr_matrix(touching), directed=False)[1]
    return len(np.unique(part[neighbours])) > 1


def _between_two(
    body: int,
    neighbours: np.ndarray,
    contacts: np.ndarray,
    model: BodyModel,
    evidence: Evidence,
    criterion: Criterion,
) -> tuple[float, bool]:
    """How badly a fixed fraction of the turn of the two best neighbours is that of a body; 1: as much as skin may.

    Also whether it turns at least as much as one of two neighbours against the other.
    """
    softness, at_end = np.inf, False
    for i, a in enumerate(neighbours):
        for b in neighbours[:i]:
            others = neighbours[(neighbours != a) & (neighbours != b)]
            elsewhere = np.maximum(contacts[others, a], contacts[others, b])
            if (elsewhere < _ALSO_TOUCHES * contacts[others, body]).any():
                continue
            known = _seen(body, model, evidence) & _seen(int(a), model, evidence) & _seen(int(b), model, evidence)
            if known.sum() < min(_LEAST_FRAMES, len(known)):
                known[:] = True
            fraction, miss, turn = fixed_fraction(
                model.rotations[a, known], model.rotations[body, known], model.rotations[b, known]
            )
            if 0.0 < fraction < 1.0:
                part = 4.0 * fraction * (1.0 - fraction) if len(neighbours) >= _HUB else 1.0
                softness = min(softness, miss / (_SOFT_FLOOR + criterion.soft_fraction * part * turn))
            else:
                at_end = True
    return softness, at_end


def fixed_fraction(first: np.ndarray, middle: np.ndarray, second: np.ndarray) -> tuple[float, float, float]:
    """Fraction of the turn between two motions that a third one turns from the first on, least squares over time.

    Parameters
    ----------
    first, middle, second : (T, 3, 3) float
        Rotations.

    Returns
    -------
    fraction : float
        0 to 1.
    miss : float, radians
        By which turning by that fraction misses the third motion in the 95th percentile of the frames.
    turn : float, radians
        95th percentile of the angle between first and second.
    """
    whole = Rotation.from_matrix(first.swapaxes(1, 2) @ second).as_rotvec()
    part = Rotation.from_matrix(first.swapaxes(1, 2) @ middle).as_rotvec()
    fraction = float(np.clip((whole * part).sum() / max((whole * whole).sum(), 1e-12), 0.0, 1.0))
    miss = (Rotation.from_rotvec(-fraction * whole) * Rotation.from_rotvec(part)).magnitude()
    return fraction, float(np.quantile(miss, _QUANTILE)), float(np.quantile(np.linalg.norm(whole, axis=1), _QUANTILE))
