"""Which joint of a template a found joint is: the likeliest assignment under which both trees are cut alike.

A found joint that the template has no counterpart for cuts one of its parts in two; a joint of the template that was
not found leaves two of its parts in one body. So bodies needn't be parts one to one. What must hold is the order: of
two joints one lies beyond the other, or each apart from the other, in both trees alike. Under that condition the sum of
the joints' log likelihood ratios (template's joint against a joint of anything) is greatest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.naming.best_assignment import heaviest_choices
from geomocap.naming.mean_posture import MeanPosture
from geomocap.naming.name_templates import NameTemplate
from geomocap.naming.tree_features import JointFeatures, PosedTree, joint_features

HEADINGS = 16  # directions in which a subject may face, of which the best is taken
PLACE = 0.05  # how far subjects differ from a template, in fractions of its longest way; standard deviation
SURFACE, REACH = 0.5, 0.25  # the same of logarithms
LATERAL = 0.5  # of that to the sides: mean postures are nearly symmetric
DEPENDENT = 0.5  # features of a joint overlap: their weight together
ALIKE = 0.5  # fraction of what a subject's left differs from a template in that its right has, too (variances)
SURE = 5.0  # log odds beyond which nobody asks
TURNED = 4.0  # log odds of a motion that shows the heading clearly
_TILTS = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])  # quarter turns


@dataclass(frozen=True)
class TreeMatch:
    """One way to match a found tree to a template.

    Attributes
    ----------
    joints : (J,) int
        Part of the template whose joint each found joint is; -1: none.
    beyond : (J, B) bool
        Bodies beyond each joint.
    turn : (3, 3) float
        Template's axes, forward, left and up, from the posture's.
    score : float
        Log likelihood ratio of the tree under the template against no template, each joint for itself.
    symmetry : float
        What joints of left and right add to it by being alike.
    """

    joints: np.ndarray
    beyond: np.ndarray
    turn: np.ndarray
    score: float
    symmetry: float = 0.0


@dataclass(frozen=True)
class _Model:
    """A template's features and how far subjects stray from them."""

    template: NameTemplate
    features: JointFeatures
    place: np.ndarray  # (K - 1,) standard deviation
    center: np.ndarray
    side: np.ndarray  # 1 left, -1 right, 0 middle

    @property
    def nesting(self) -> np.ndarray:
        return self.features.nesting


def match_tree(posture: MeanPosture, template: NameTemplate, least: float = -np.inf) -> list[TreeMatch]:
    """Match the joints of a posture to a template: the likeliest way, and others that are not much less likely.

    The others are the best ones with the subject facing another way, with one joint each taken for something else, or
    for nothing that the template has, and the best one of all with left and right exchanged.

    Parameters
    ----------
    posture : MeanPosture
    template : NameTemplate
    least : float
        Scores below are not looked for.

    Returns
    -------
    list of TreeMatch
        The best one first, none twice; none at all if the best is below the least.
    """
    model = _template_model(template)
    found = joint_features(posture.tree, both_ways=True)
    tries = []
    for turn in _turns(template):
        gains = _gains(found, model, turn)
        cue = TURNED * float(posture.heading @ turn[0, :2]) if template.upright else 0.0
        tries.append((float(np.maximum(_best_by_joint(gains), 0).sum()) + cue, cue, turn, gains))
    tries.sort(key=lambda one: -one[0])
    ways: dict[bytes, TreeMatch] = {}

    def keep(chosen: np.ndarray, cue: float, turn: np.ndarray, gains: np.ndarray) -> None:
        score = cue + _sum(gains, chosen)
        known = ways.get(chosen.tobytes())
        if np.isfinite(score) and (known is None or known.score < score):
            ways[chosen.tobytes()] = _match(found, chosen, turn, score, _symmetry(found, model, turn, chosen))

    best = least + SURE
    facing: list[tuple[float, np.ndarray, float, np.ndarray, np.ndarray]] = []
    for bound, cue, turn, gains in tries:
        if bound > max(best - SURE, least):
            chosen = _assign(found, model, gains, max(best - SURE, least) - cue)
            if chosen is not None:
                keep(chosen, cue, turn, gains)
                score = cue + _sum(gains, chosen)
                best = score if not facing else max(best, score)
                facing.append((score, chosen, cue, turn, gains))
    if not facing:
        return []
    # what else joints may be is asked of each direction that may be that of the subject
    for score, chosen, cue, turn, gains in facing:
        if score > best - SURE:
            for barred in _barred(found, chosen, template):
                other = _assign(found, model, np.where(barred, -np.inf, gains), best - SURE - cue)
                if other is not None:
                    keep(other, cue, turn, gains)
    chosen = max(facing, key=lambda one: one[0])[1]
    exchanged = np.where(chosen >= 0, template.mirrored[np.maximum(chosen, 0) + 1] - 1, -1)
    for _, cue, turn, gains in tries:
        keep(exchanged, cue, turn, gains)
    return sorted(ways.values(), key=lambda way: -way.score - way.symmetry)


def _barred(found: JointFeatures, chosen: np.ndarray, template: NameTemplate) -> Iterator[np.ndarray]:
    """What each joint is taken for, (V, K - 1) bool: that part, that or its mirror image, and any part at all."""
    for v in np.flatnonzero(chosen >= 0).tolist():
        part = int(chosen[v]) + 1
        nothing = list(range(1, len(template.parts)))
        for parts in ([part], [part, int(template.mirrored[part])], nothing):
            barred = np.zeros((len(chosen), len(template.parts) - 1), bool)
            barred[np.ix_(found.joint == found.joint[v], np.array(parts) - 1)] = True
            yield barred


def decoy_score(posture: MeanPosture, template: NameTemplate, least: float) -> float:
    """Greatest score of a template turned over by a quarter, to any side; `least` if none is above it.

    Any tree can be matched to a template somehow; only one that is no such thing fits it as well turned over. (Upside
    down is no test: a flat animal, a bird in flight, looks nearly the same then.)

    Parameters
    ----------
    posture : MeanPosture
    template : NameTemplate
    least : float
    """
    cue = TURNED * float(np.linalg.norm(posture.heading))
    best = least
    for tilt in Rotation.from_rotvec(np.pi / 2 * _TILTS).as_matrix():
        best = cue + _best_score(posture.tree, template, tilt, best - cue)
    return best


def _best_score(tree: PosedTree, template: NameTemplate, tilt: np.ndarray, least: float) -> float:
    """Greatest score of a tilted template, whichever way it faces; `least` if none is above it."""
    model = _template_model(template)
    found = joint_features(tree, both_ways=True)
    for turn in _turns(template):
        gains = _gains(found, model, turn @ tilt)
        if np.maximum(_best_by_joint(gains), 0).sum() > least:
            chosen = _assign(found, model, gains, least)
            least = least if chosen is None else _sum(gains, chosen)
    return least


def perfect_gain(template: NameTemplate) -> float:
    """Mean score of a joint of a subject that is exactly as a template.

    Parameters
    ----------
    template : NameTemplate
    """
    model = _template_model(template)
    return float(_gains(model.features, model, np.eye(3)).diagonal().mean())


def part_places(template: NameTemplate) -> tuple[np.ndarray, np.ndarray]:
    """Centres of a template's parts, (K, 3), from the middle of all, and how far they stray, (K, 3).

    In fractions of the longest way through the tree: forward, left and up.

    Parameters
    ----------
    template : NameTemplate
    """
    tree = _template_tree(template)
    diameter = joint_features(tree, both_ways=False).diameter
    places = (template.centers - template.surfaces @ template.centers) / diameter
    stray = np.full(len(template.parts), PLACE**2)
    for k in range(1, len(template.parts)):
        joint = k
        while joint > 0:
            lever = np.linalg.norm(template.centers[k] - template.joint_places[joint]) / diameter
            stray[k] += (template.mobility[joint] * lever) ** 2
            joint = int(template.parents[joint])
    return places, np.sqrt(stray)[:, None] * [1.0, LATERAL, 1.0]


def body_places(posture: MeanPosture, turn: np.ndarray) -> np.ndarray:
    """Centres of a posture's bodies, (B, 3), from the middle of all, as `part_places` has them.

    Parameters
    ----------
    posture : MeanPosture
    turn : (3, 3) float
        Template's axes from the posture's.
    """
    tree = posture.tree
    diameter = joint_features(tree, both_ways=False).diameter
    return (tree.centers - tree.surfaces @ tree.centers) @ turn.T / diameter


def _match(found: JointFeatures, chosen: np.ndarray, turn: np.ndarray, score: float, symmetry: float) -> TreeMatch:
    count = len(chosen) // 2
    parts, beyond = np.full(count, -1), found.beyond[:count].copy()
    for v in np.flatnonzero(chosen >= 0).tolist():
        parts[found.joint[v]], beyond[found.joint[v]] = chosen[v] + 1, found.beyond[v]
    return TreeMatch(parts, beyond, turn, score, symmetry)


def _turns(template: NameTemplate) -> Iterator[np.ndarray]:
    """Directions in which a subject may lie: about the vertical, or any."""
    if template.upright:
        angles = 2 * np.pi * np.arange(HEADINGS) / HEADINGS
        yield from Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    else:
        cubes = Rotation.create_group("O").as_matrix()
        yield from cubes
        yield from Rotation.from_rotvec([np.pi / 4, 0.0, 0.0]).as_matrix() @ cubes


def _template_tree(template: NameTemplate) -> PosedTree:
    joints, count = template.joint_places[1:], len(template.parts)
    lengths = np.full((count, count - 1), np.nan)
    for j, both in enumerate(template.hierarchy.joint_bodies.tolist()):
        for part in both:
            end = template.tips[part] if np.isfinite(template.tips[part]).all() else template.centers[part]
            lengths[part, j] = np.linalg.norm(end - joints[j])
    return PosedTree(template.hierarchy, joints, template.centers, lengths, template.surfaces)


def _template_model(template: NameTemplate) -> _Model:
    """Return a template's features with their spread: what is farther out along a limb strays farther."""
    tree = _template_tree(template)
    features = joint_features(tree, both_ways=False)
    joints, count = tree.joints, len(template.parts)
    inside = features.beyond[:, 1:].T & ~np.eye(count - 1, dtype=bool)  # [k, a]: joint k lies beyond joint a
    ways = np.linalg.norm(joints[:, None] - joints[None], axis=2) / features.diameter
    mobility = template.mobility[1:]
    place = np.sqrt(PLACE**2 + ((inside * ways * mobility) ** 2).sum(axis=1))
    center = np.sqrt(PLACE**2 + (mobility * np.linalg.norm(features.center, axis=1)) ** 2)
    side = np.array([{"left": 1, "right": -1, "": 0}[s] for s in template.sides[1:]])
    return _Model(template, features, place, center, side)


def _gains(found: JointFeatures, model: _Model, turn: np.ndarray) -> np.ndarray:
    """Log likelihood ratios, (V, K - 1), of found joints as joints of a template turned some way."""
    errors, spreads, widths = _errors(found, model, turn)
    gains = (np.log(widths / (np.sqrt(2 * np.pi) * spreads)) - 0.5 * errors**2).sum(axis=-1) * DEPENDENT
    if model.template.upright:  # what hangs on a joint of the left lies to the left of the middle
        lateral = ((found.place + found.center) @ turn.T)[:, 1, None]
        gains[lateral * model.side < 0] = -np.inf
    return gains


def _errors(found: JointFeatures, model: _Model, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of eight features in their standard deviations, (V, K - 1, 8), these, (K - 1, 8), and widths to choose in.

    The last six are the joint's place and the centre beyond it, forward, left and up.
    """
    known = model.features
    errors = np.concatenate(
        [
            (found.surface[:, None] - known.surface)[..., None],
            (found.reach[:, None] - known.reach)[..., None],
            (found.place @ turn.T)[:, None] - known.place,
            (found.center @ turn.T)[:, None] - known.center,
        ],
        axis=-1,
    )
    axes = np.array([1.0, LATERAL, 1.0])
    like = np.ones_like(model.place)[:, None]
    spreads = np.hstack([SURFACE * like, REACH * like, model.place[:, None] * axes, model.center[:, None] * axes])
    return errors / spreads, spreads, np.array([np.log(100), np.log(20), 1, 1, 1, 1, 1, 1])


def _symmetry(found: JointFeatures, model: _Model, turn: np.ndarray, chosen: np.ndarray) -> float:
    """Log likelihood ratio of joints of the left and right that differ from the template alike.

    Of two normal variables that share a part of their variance, against two that don't.
    """
    view = {int(part): v for v, part in enumerate(chosen.tolist()) if part >= 0}
    mirrored = model.template.mirrored[1:] - 1
    pairs = [(k, int(mirrored[k])) for k in view if model.side[k] > 0 and int(mirrored[k]) in view]
    if not pairs:
        return 0.0
    errors, _, _ = _errors(found, model, turn)
    a = np.array([errors[view[left], left] for left, _ in pairs])
    b = np.array([errors[view[right], right] for _, right in pairs]) * [1, 1, 1, -1, 1, 1, -1, 1]
    rest = 1 - ALIKE**2
    apart = a**2 + b**2
    return DEPENDENT * float((0.5 * apart - (apart - 2 * ALIKE * a * b) / (2 * rest) - 0.5 * np.log(rest)).sum())


def _best_by_joint(gains: np.ndarray) -> np.ndarray:
    return gains.max(axis=1).reshape(2, -1).max(axis=0)


def _sum(gains: np.ndarray, chosen: np.ndarray) -> float:
    return float(gains[chosen >= 0, chosen[chosen >= 0]].sum())


def _assign(found: JointFeatures, model: _Model, gains: np.ndarray, above: float = -np.inf) -> np.ndarray | None:
    """Joint of the template for each way to look at a found joint, (V,) int; -1: none. None: no sum is above."""
    views, parts = np.nonzero(gains > 0)
    chosen = np.full(len(gains), -1)
    excluded = found.nesting[np.ix_(views, views)] != model.nesting[np.ix_(parts, parts)]
    taken = heaviest_choices(gains[views, parts], found.joint[views], parts, excluded, above)
    if taken is None:
        return None
    chosen[views[taken]] = parts[taken]
    return chosen
