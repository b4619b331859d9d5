"""When a body is one: it pays for its freedoms with motion that its neighbours and blends of them do not explain.

A body that is added to a model has three more freedoms in each frame, its turn; a joint holds the rest. It has to
explain so much that the likelihood of the samples grows by more than these freedoms are worth (Bayesian information
criterion, Schwarz 1978). Both count for each freedom in time, so the length of a recording cancels:

    1/2 n log[(s² + e² + c) / (s² + e² + o)]  >  3/2 log n

n is the number of independent observations: neighbouring samples err together, and where one camera alone sees them
they are two numbers and not three. c is the mean square by which bodies and blends without this one miss a sample, o
that with it, where each may choose the place of the sample at rest: frame 0 is as noisy as any other, only motion is
compared. s² is the noise that is everywhere on the surface, and e what soft skin between two bodies may differ from a
blend of them: a fixed fraction of how far they turn it apart, but no more than the least turn of a body would move it.
What turns it apart is a joint in its midst. Trunk and shank have none in a thigh: what their motions carry even their
best common point apart is not counted, and the thigh is no soft skin of both.

Paths that went astray move with nothing, and any body misses them by a little less than the others do. What misses a
sample by r is no explanation where the sample might as well be anywhere in the scene, of diagonal D: a normal law of s
in each direction is below the uniform one, 1 / D³, from r² = 6 s² ln(D / s) on, at 6 or 7 s. What the least turn of a
body moves it by, which soft skin may do, comes to r². Misses beyond count as r. (With a quarter of that a horse of
perfect tracks came in 12 bodies instead of 18, of 14.)

Nor do joints come free. Without the thigh, trunk and shank would have to meet in a joint, or the shank has as many
freedoms more as the thigh has. So to what a body explains of its samples comes what it adds to the likelihood of the
joints: they part by a mean square p with it and by q without, and of each that it makes needless

    3/2 log[(s² + q) / (s² + p)]

is added. Which bodies meet is the tree that parts least, among its neighbours with it and without it.

What touches a body and turns as it does may still move otherwise, if nothing joins the two: a cape on a back, an axe
before a helmet. So to a turn comes how far the motions of both carry their best common point apart, as far as that is
more than with the neighbour that the body hangs on: skin and folds of cloth slide a little against all of them, and
as far as small pieces of them are wide. Neither explains much: what is sure beyond doubt may slide on what it hangs on,
and a small body along a large one. Where depths are unsure, sliding tells nothing. What only slides and turns in no way
isn't found: first groups are made of turns.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_joints import Borders, held_together, motion_known, neighbours_of, parted, parting
from geomocap.bodies.body_model import BodyModel, Evidence
from geomocap.bodies.body_settings import FOLLOWED
from geomocap.bodies.rigid_motions import relative_turn
from geomocap.bodies.skin_blending import blend_spans

_FREEDOMS = 3  # of a turn
_FITTED = 6  # freedoms that were fitted to a body's own samples
_MOST_SAMPLES = 80
_MOST_NEIGHBOURS = 7
TURN_FRACTION = 0.02  # of the frames, in which a turn may be larger
# Noise turns n samples by three angles, each of variance s²/2 / (n radius²); with the 98th percentile of their χ²:
_FEIGNED = 9.84 / 2.0
_CLEARLY = np.deg2rad(40.0)
# Times the required evidence, from which a body is no skin whatever way it moves. Of 72 waves of cloth as many left a
# body with it and without (22 %), of 64 sets of true points the mean core index went from 0.831 to 0.840.
_BEYOND_DOUBT = 10.0
_TIP_QUANTILE = 0.8
# Turns of neighbourhoods that share most of their samples err together: those of samples far apart differ by noise
# about so many times as much as those side by side. 2 merged soft joints of a man, 1.5 didn't; both mended a machine.
_NOISE_FACTOR = 1.5
_UNEVEN = np.deg2rad(10.0)  # samples side by side that turn more differently are unsure


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
    turn : float, radians
        Least turn against a neighbour, with what it slides, without what noise feigns.
    evidence : float
        What it explains over what its freedoms cost.
    """

    body: int
    strength: float
    into: int
    turn: float
    evidence: float

    @property
    def confidence(self) -> float:
        """0 to 1: 1/2 where what speaks for the body is just what is required, 2/3 where it is twice that."""
        return float(confidence_of(np.array(self.strength)))


def confidence_of(strength: np.ndarray) -> np.ndarray:
    """Confidences, 0 to 1, of what speaks for bodies, as a fraction of what is required; see `Candidate`."""
    result: np.ndarray = 1.0 - 1.0 / (1.0 + strength)
    return result


# Of two bodies, the lower number first, against each other: turn, radians, and slide, metres
Turns = dict[tuple[int, int], tuple[float, float]]


def judge(
    bodies: Iterable[int], model: BodyModel, evidence: Evidence, criterion: Criterion, turns: Turns | None = None
) -> dict[int, Candidate]:
    """What speaks for some bodies, by their number.

    The evidence of a body of few samples must be greater by as much as it is too small: limbs are often followed by
    few, and noise is no limb.

    Parameters
    ----------
    bodies : iterable of int
    model : BodyModel
    evidence : Evidence
    criterion : Criterion
    turns : dict, optional
        Turns that are known already; what is found is added.
    """
    borders, turns = Borders.of(model, evidence), {} if turns is None else turns
    evidence = only_seen(evidence)
    return {b: _judge(b, model, evidence, criterion, borders, turns) for b in bodies}


def _judge(
    body: int, model: BodyModel, evidence: Evidence, criterion: Criterion, borders: Borders, known: Turns
) -> Candidate:
    contacts = borders.contacts
    members, touching = np.flatnonzero(model.label == body), contacts[body]
    if not len(members) or not touching.any():
        return Candidate(body, np.inf, -1, np.inf, np.inf)
    neighbours = np.flatnonzero(neighbours_of(touching))
    some, samples, observations = observed(members, evidence, criterion)
    nats, own = _explained(body, neighbours, some, observations, model, evidence, criterion, borders)
    nats += held_together(body, neighbours, model, criterion, borders)
    by_evidence = of_required(nats, observations, members, evidence, criterion)
    # what noise feigns is no turn
    inertia = max(samples, 1.0) * _square_radius(evidence.rest[members])
    feigned = _FEIGNED * max(criterion.noise.variance, own) / max(inertia, 1e-12)
    pairs = [(min(body, q), max(body, q)) for q in neighbours.tolist()]
    known.update((pair, _motion(*pair, model, evidence, criterion, borders)) for pair in pairs if pair not in known)
    radii = [math.sqrt(max(_square_radius(evidence.rest[model.label == b]), 1e-12)) for b in (body, *neighbours)]
    turns = _with_slides([known[pair] for pair in pairs], radii[0], radii[1:], by_evidence >= _BEYOND_DOUBT)
    turn = float(np.sqrt(max(min(turns) ** 2 - feigned, 0.0)))
    by_turn, into = turn / criterion.min_turn, int(neighbours[int(np.argmin(turns))])
    return Candidate(body, min(by_evidence, by_turn), into if by_turn < by_evidence else -1, turn, by_evidence)


def observed(members: np.ndarray, evidence: Evidence, criterion: Criterion) -> tuple[np.ndarray, float, float]:
    """Evenly chosen samples of a body, and how many independent samples and observations of directions it has."""
    some = members
    if len(members) > _MOST_SAMPLES:
        some = members[np.linspace(0, len(members) - 1, _MOST_SAMPLES).astype(int)]
    samples = criterion.noise.independent(evidence.rest[some], len(members)) * _coverage(evidence.seen[members])
    return some, samples, _directions(members, evidence) * samples


def of_required(
    nats: float, observations: float, members: np.ndarray, evidence: Evidence, criterion: Criterion
) -> float:
    """Log likelihood that a body adds, over what its freedoms cost: less where its samples are too few."""
    size = float(evidence.counts[members].sum()) / max(criterion.min_fraction * len(evidence.rest), 1e-12)
    return nats / (0.5 * _FREEDOMS * math.log(max(observations, math.e))) * min(size, 1.0)


def only_seen(evidence: Evidence) -> Evidence:
    """The same, of what is seen alone: gaps are filled by guesses."""
    return replace(evidence, weights=np.ascontiguousarray(np.where(evidence.seen, evidence.weights, 0.0)))


def _explained(
    body: int,
    neighbours: np.ndarray,
    some: np.ndarray,
    observations: float,
    model: BodyModel,
    evidence: Evidence,
    criterion: Criterion,
    borders: Borders,
) -> tuple[float, float]:
    """Log likelihood that a body adds to that of its samples, in nats, and the mean square by which it misses them."""
    reached = np.bincount(model.label[evidence.near[some].indices], minlength=model.count)
    reached[body] = 0
    reached[neighbours] += len(model.label)  # those that touch come first
    others = np.argsort(-reached, kind="stable")[: min(_MOST_NEIGHBOURS, int((reached > 0).sum()))]
    allowed = np.zeros((len(some), model.count), bool)
    allowed[:, others] = True
    allowed[:, body] = True
    blended = np.zeros((model.count, model.count), bool)
    blended[np.ix_(neighbours, neighbours)] = True
    blended[body] = True
    found = evidence.explain(some, model, allowed, blended, 0.0)
    own = found.costs[:, body].copy()
    found.costs[:, body] = np.inf  # without it
    row, main = np.arange(len(some)), found.costs.argmin(axis=1)
    missed, partner, fraction = found.costs[row, main], found.partner[row, main], found.fraction[row, main]
    noise = noise_of(some, main, partner, fraction, model, evidence, criterion, borders)
    # what was fitted to few independent observations leaves less than they really miss
    most = gross(noise, some, evidence, criterion)
    gain = np.log((noise + np.minimum(missed, most)) / (noise + np.minimum(fitted(observations) * own, most)))
    gain = np.maximum(gain, 0.0)
    return 0.5 * observations * float(gain.mean()), float(own.mean())


def gross(noise: np.ndarray, some: np.ndarray, evidence: Evidence, criterion: Criterion) -> np.ndarray:
    """Mean squares of misses from which on they are gross errors, (n,), metres², of samples (n,) with so much noise."""
    diagonal = evidence.noise / FOLLOWED
    by_noise: np.ndarray = 6.0 * noise * np.log(np.maximum(diagonal / np.sqrt(noise), math.e))
    return by_noise + _of_least_turn(some, evidence, criterion)


def fitted(observations: float) -> float:
    """What a body really misses its samples by, as a multiple of what is left of so many after its fit to them."""
    return observations / max(observations - _FITTED, 1.0)


def noise_of(
    some: np.ndarray,
    main: np.ndarray,
    partner: np.ndarray,
    fraction: np.ndarray,
    model: BodyModel,
    evidence: Evidence,
    criterion: Criterion,
    borders: Borders,
) -> np.ndarray:
    """Mean square by which blends may miss their samples, (n,), metres²: noise, and the softness of skin."""
    stated = 3.0 * evidence.sigma[some] ** 2
    if evidence.ray is not None:  # what one camera alone sees is as unsure as its depth says, which hardly counts
        stated[evidence.lone[some].any(axis=1)] = 0.0
    noise: np.ndarray = np.maximum(criterion.noise.variance, stated)
    if criterion.softness > 0:
        apart = _turned_apart(some, main, partner, model, evidence, criterion, borders)
        soft = 4.0 * fraction * (1.0 - fraction) * criterion.softness**2 * apart
        noise += np.minimum(soft, _of_least_turn(some, evidence, criterion))
    return noise


def _of_least_turn(some: np.ndarray, evidence: Evidence, criterion: Criterion) -> float:
    """Mean square by which a swing of the least turn moves samples around their middle: a² r² / 3, metres²."""
    return criterion.min_turn**2 / 3.0 * _square_radius(evidence.rest[some])


def _turned_apart(
    some: np.ndarray,
    main: np.ndarray,
    partner: np.ndarray,
    model: BodyModel,
    evidence: Evidence,
    criterion: Criterion,
    borders: Borders,
) -> np.ndarray:
    """Mean square by which the two bodies of their blends turn samples apart, (n,), metres²; 0 without a second.

    By as much as both motions carry even their best common point apart no joint between them does, and the samples are
    no skin around one. Frames are weighted as they are in what is missed of a sample: those in which it isn't seen
    don't count. Where single cameras follow the surface it may stand off, and nothing is taken to part.
    """
    weights, rest = evidence.weights[some], evidence.rest[some]
    apart = blend_spans(main, partner, weights, rest, model.rotations, model.translations)
    if evidence.ray is not None:
        return apart
    middle = rest.mean(axis=0)
    for one, other in np.unique(np.stack([main, partner])[:, partner >= 0], axis=1).T.tolist():
        parted = parting(one, other, middle, model, criterion, borders).var(axis=0).sum()
        apart[(main == one) & (partner == other)] -= parted
    return np.maximum(apart, 0.0)


def _square_radius(places: np.ndarray) -> float:
    """Mean square distance of samples (n, 3) from their middle, metres²."""
    return float(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean())


def _coverage(seen: np.ndarray) -> float:
    """Fraction of a body's samples (n, T) that are seen in a frame in which enough of them are to know its motion."""
    known = motion_known(seen)
    return float(seen[:, known].mean()) if known.any() else 0.0


def _directions(members: np.ndarray, evidence: Evidence) -> float:
    """Directions in which a position is sure, on average: 3, or 2 where one camera alone sees the sample."""
    if evidence.ray is None:
        return 3.0
    seen = evidence.seen[members]
    return 3.0 - float((evidence.lone[members] & seen).sum() / max(seen.sum(), 1))


def _motion(
    first: int, second: int, model: BodyModel, evidence: Evidence, criterion: Criterion, borders: Borders
) -> tuple[float, float]:
    """Turn and slide of two bodies against each other, in the frames that show both.

    They slide by what their motions carry their best common point near the border apart. Where single cameras follow
    the surface it may stand off, and slides then without being another body: there it is 0.
    """
    turn = _turn(first, second, model, evidence, borders)
    if evidence.ray is not None:
        return turn, 0.0
    miss = parted(first, second, borders.places[first, second], model, criterion, borders)
    return turn, math.sqrt(miss)


def _with_slides(motions: list[tuple[float, float]], own: float, others: list[float], sure: bool) -> list[float]:
    """Turns against neighbours, radians, with what the body slides on them as an angle.

    Parameters
    ----------
    motions : list of (float, float)
        Turn and slide against each.
    own, others : float, list of float
        Radius of the body, and of each neighbour.
    sure : bool
        Whether it is no skin. Its slides count in its own radius then, all of them; else in that of the larger one, and
        as far as they are more than on the neighbour that it hangs on.
    """
    slides = [slide / (own if sure else max(own, other)) for (_, slide), other in zip(motions, others, strict=True)]
    joined = 0.0 if sure else min(slides)
    return [math.hypot(turn, math.sqrt(s**2 - joined**2)) for (turn, _), s in zip(motions, slides, strict=True)]


def _turn(first: int, second: int, model: BodyModel, evidence: Evidence, borders: Borders) -> float:
    """Turn of two bodies against each other: mean of that of their motions and of their most different parts.

    What samples side by side turn differently is noise, which is taken from that of the parts; where it is so much that
    they are unsure, that of the motions counts more.
    """
    known = borders.shown(first, second)
    one, other = model.rotations[first, known], model.rotations[second, known]
    if min(evidence.seen[model.label == body, 0].sum() for body in (first, second)) < 3:
        # nothing ties the body to frame 0: its turn counts from the middle of the frames
        at = len(one) // 2
        return relative_turn(one @ one[at].T, other @ other[at].T, TURN_FRACTION)
    turn = relative_turn(one, other, TURN_FRACTION)
    if turn > _CLEARLY:
        return turn
    a = np.flatnonzero((model.label == first) & model.core)
    b = np.flatnonzero((model.label == second) & model.core)
    if min(len(a), len(b)) < 4:
        return turn
    tips = float(np.quantile(evidence.turns[np.ix_(a, b)], _TIP_QUANTILE))
    uneven = np.sqrt(np.mean([np.median(evidence.unevenness[some]) ** 2 for some in (a, b)]))
    tips = float(np.sqrt(max(tips**2 - (_NOISE_FACTOR * uneven) ** 2, 0.0)))
    fraction = 0.5 * min(1.0, (_UNEVEN / max(float(uneven), 1e-9)) ** 2)
    return (1.0 - fraction) * turn + fraction * tips
