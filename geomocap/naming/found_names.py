"""Names of bodies and joints from the ways in which a tree can be matched to templates.

A name is given where most of the likelihood of all ways is for it; left and right where next to all of it is: otherwise
the two sides are called a and b. What isn't known keeps its number.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from geomocap.model.skeleton import Skeleton
from geomocap.naming.mean_posture import BodySurface, MeanPosture, mean_posture
from geomocap.naming.name_templates import SIDES, NameTemplate, read_template
from geomocap.naming.tree_matching import (
    SURE,
    TreeMatch,
    body_places,
    decoy_score,
    match_tree,
    part_places,
    perfect_gain,
)

LIKELY = 0.7  # a name is given
CERTAIN = 0.9  # left and right are told
AUTOMATIC = ("human", "quadruped", "bird")  # a hand may lie anyhow; with few joints most trees would fit it
FITS = 0.5  # fraction of a perfect subject's score that a tree must have for each of its joints
FAR = 3.0  # standard deviations within which a body lies
MOST_WORDS = 3  # of parts in one body's name
KEPT = 4  # names found last, for those who ask again: motion files, their angles, the report


@dataclass(frozen=True)
class FoundNames:
    """Names of bodies and joints of a skeleton; those that are not known are not in it.

    Attributes
    ----------
    template : NameTemplate or None
        None: no template fits clearly better than the others.
    bodies, joints : dict of number to name
    confidence, joint_confidence : dict of number to float
        Of the names given; left and right included where they are told.
    parts : dict of number to tuple of int
        The template's parts in each named body.
    joint_parts : dict of number to int
        The template's part whose joint each named joint is.
    sides_known : bool
        Whether left and right are told.
    from_world : (3, 3) float or None
        Forward, left and up from the world's axes in the first frame, if the heading is told.
    scores : dict of template's name to log likelihood ratio
        Those that come near the best.
    surface : BodySurface or None
        What the bodies looked like in the first frame.
    """

    template: NameTemplate | None = None
    bodies: dict[int, str] = field(default_factory=dict)
    joints: dict[int, str] = field(default_factory=dict)
    confidence: dict[int, float] = field(default_factory=dict)
    joint_confidence: dict[int, float] = field(default_factory=dict)
    parts: dict[int, tuple[int, ...]] = field(default_factory=dict)
    joint_parts: dict[int, int] = field(default_factory=dict)
    sides_known: bool = False
    from_world: np.ndarray | None = None
    scores: dict[str, float] = field(default_factory=dict)
    surface: BodySurface | None = None

    @property
    def whole(self) -> dict[int, str]:
        """Names of the bodies that are not what was cut off from a part, as thigh_left_2."""
        return {b: name for b, name in self.bodies.items() if not name.rsplit("_", 1)[-1].isdigit()}

    @property
    def unparted(self) -> dict[str, str]:
        """Joints that were not found because both their parts are in one body, with the name of that body."""
        template, found = self.template, {}
        if template is None:
            return {}
        seen = set(self.joint_parts.values())
        for b, name in self.whole.items():
            for part in self.parts[b]:
                if part and part not in seen and template.parents[part] in self.parts[b]:
                    found[_with_side(template.joints[part], template.sides[part], known=self.sides_known)] = name
        return found

    @property
    def trunk(self) -> int | None:
        """The body that the template's tree grows from, as the pelvis of a person; None if it isn't named."""
        return next((b for b in sorted(self.whole) if 0 in self.parts[b]), None)


def find_names(
    skeleton: Skeleton,
    up: int,
    surface: BodySurface | None = None,
    templates: Sequence[NameTemplate] | None = None,
) -> FoundNames:
    """Find names for the bodies and joints of a skeleton.

    Parameters
    ----------
    skeleton : Skeleton
    up : int
        World axis that points up, 0 to 2.
    surface : BodySurface, optional
        In the first frame; without it names are less sure.
    templates : sequence of NameTemplate, optional
        By default those of whole subjects that come with the package. Of several one must fit clearly better than the
        others.
    """
    if not skeleton.joint_count:
        return FoundNames()
    if templates is not None:
        return _find(skeleton, up, surface, list(templates))
    key = _digest(skeleton, up, surface)
    found = _found.get(key)
    if found is None:
        found = _find(skeleton, up, surface, [read_template(name) for name in AUTOMATIC])
        _found[key] = found
        for old in list(_found)[:-KEPT]:
            _found.pop(old, None)
    return found


_found: dict[bytes, FoundNames] = {}  # by the digest of all that they follow from


def _digest(skeleton: Skeleton, up: int, surface: BodySurface | None) -> bytes:
    """Digest of what names are found by; those that bodies and joints have don't count."""
    s = skeleton
    arrays = [s.joint_positions, s.joint_bodies, s.body_rotations, s.body_positions, s.offsets, s.body_offsets]
    arrays += [] if surface is None else [surface.points, surface.bodies]
    digest = hashlib.sha256(repr((up, s.root, s.fixed_joints, s.fps)).encode())
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def _find(skeleton: Skeleton, up: int, surface: BodySurface | None, asked: list[NameTemplate]) -> FoundNames:
    posture = mean_posture(skeleton, up, surface)
    best: tuple[NameTemplate, list[TreeMatch]] | None = None
    scores: dict[str, float] = {}
    for template in asked:
        ways = match_tree(posture, template, best[1][0].score - SURE if best else -np.inf)
        if ways:
            scores[template.name] = ways[0].score
        if ways and (best is None or ways[0].score > best[1][0].score):
            best = template, ways
    if best is None:
        return FoundNames(scores=scores)
    others = [0.0, *(score for name, score in scores.items() if name != best[0].name)]
    score = best[1][0].score
    if len(asked) > 1 and (
        score < FITS * perfect_gain(best[0]) * skeleton.joint_count
        or score - max(others) < SURE
        or decoy_score(posture, best[0], score - SURE) > score - SURE
    ):
        return FoundNames(scores=scores)
    return replace(_names(posture, best[0], best[1], scores), surface=surface)


def _names(posture: MeanPosture, template: NameTemplate, ways: list[TreeMatch], scores: dict[str, float]) -> FoundNames:
    weights = _shares([way.score + way.symmetry for way in ways])
    apart = _shares([way.score for way in ways])  # that both sides are alike doesn't tell which is the left
    regions = [_regions(way, template) for way in ways]
    bodies: dict[int, tuple[frozenset[int], float]] = {}
    sides_known = True
    places = body_places(posture, ways[0].turn)
    for body in range(len(posture.tree.centers)):
        held: dict[frozenset[int], float] = defaultdict(float)
        for weight, region in zip(weights, regions, strict=True):
            held[region[body]] += float(weight)
        parts, likelihood = likely_parts(held, template)
        if likelihood >= LIKELY and _in_place(places[body], parts, template):
            bodies[body] = parts, likelihood
            here = float(apart[[parts <= region[body] for region in regions]].sum())
            other = frozenset(int(template.mirrored[p]) for p in parts)
            there = float(apart[[other <= region[body] for region in regions]].sum())
            if _side(parts, template) and here < CERTAIN * (here + there):
                sides_known = False
    if not any(_side(parts, template) for parts, _ in bodies.values()):
        sides_known = False
    joints, joint_parts, joint_confidence = {}, {}, {}
    for j in range(len(posture.tree.joints)):
        part = _likely_joint(j, ways, weights, template)
        if part is not None:
            joint_parts[j], joint_confidence[j] = part
            joints[j] = _with_side(template.joints[part[0]], template.sides[part[0]], known=sides_known)
    names, confidence = {}, {}
    for body, (parts, fraction) in bodies.items():
        name = _name(parts, template, sides_known=sides_known)
        if name is not None:
            names[body], confidence[body] = name, fraction
    return FoundNames(
        template=template,
        bodies=_numbered(names, posture.tree.surfaces),
        joints=_numbered(joints, np.array([joint_confidence.get(j, 0.0) for j in range(len(posture.tree.joints))])),
        confidence=confidence,
        joint_confidence=joint_confidence,
        parts={body: tuple(sorted(bodies[body][0])) for body in names},
        joint_parts=joint_parts,
        sides_known=sides_known,
        from_world=ways[0].turn @ posture.from_world if sides_known else None,
        scores=scores,
    )


def likely_parts(held: Mapping[frozenset[int], float], template: NameTemplate) -> tuple[frozenset[int], float]:
    """Return the parts in a body, and how likely they are, on these sides or the others.

    Where a limb was cut at one joint and it isn't sure which, what the body holds anyhow is told: "hand" of what may be
    hand and forearm.

    Parameters
    ----------
    held : mapping of set of parts to float
        What the body may hold, and how likely that is.
    template : NameTemplate
    """
    best = max(held.items(), key=lambda one: one[1])[0]
    alike = sum(w for parts, w in held.items() if _unsided(parts, template) == _unsided(best, template))
    if alike >= LIKELY:
        return best, alike
    has = {p: sum(w for parts, w in held.items() if template.parts[p] in _unsided(parts, template)) for p in best}
    sure = frozenset(p for p in best if has[p] >= LIKELY)
    other = frozenset(int(template.mirrored[p]) for p in sure)
    return sure, sum(w for parts, w in held.items() if sure and (sure <= parts or other <= parts))


def _shares(scores: Sequence[float]) -> np.ndarray:
    """Likelihoods that add up to 1, of their logarithms."""
    weights = np.exp(np.array(scores) - max(scores))
    return weights / weights.sum()


def _in_place(place: np.ndarray, parts: frozenset[int], template: NameTemplate) -> bool:
    """Whether a body lies where its parts can be, and on their side; pieces of a wrong tree may not."""
    if not parts or not template.upright:
        return bool(parts)
    places, stray = part_places(template)
    mine = sorted(parts)
    between = np.clip(place, places[mine].min(axis=0), places[mine].max(axis=0))
    side = _side(parts, template)
    off = np.linalg.norm((place - between) / stray[mine].max(axis=0))
    return bool(off <= FAR) and (not side or (place[1] > 0) == (side == "left"))


def _likely_joint(
    joint: int, ways: list[TreeMatch], weights: np.ndarray, template: NameTemplate
) -> tuple[int, float] | None:
    """The part whose joint it is, and how likely, whichever the side; None: it may be none."""
    held: dict[int, float] = defaultdict(float)
    for weight, way in zip(weights, ways, strict=True):
        held[int(way.joints[joint])] += float(weight)
    part = max(held.items(), key=lambda one: one[1])[0]
    if part < 0:
        return None
    likelihood = sum(held[p] for p in {part, int(template.mirrored[part])})
    return (part, likelihood) if likelihood >= LIKELY else None


def _regions(way: TreeMatch, template: NameTemplate) -> list[frozenset[int]]:
    """Parts of the template in each body: those beyond the same matched joints as the body is."""
    matched = np.flatnonzero(way.joints >= 0)
    within = {int(k): template_beyond(template, int(k)) for k in way.joints[matched]}
    holds: dict[frozenset[int], list[int]] = {}
    for part in range(len(template.parts)):
        holds.setdefault(frozenset(k for k, mask in within.items() if mask[part]), []).append(part)
    count = way.beyond.shape[1]
    keys = [frozenset(int(way.joints[j]) for j in matched if way.beyond[j, body]) for body in range(count)]
    return [frozenset(holds.get(key, [])) for key in keys]


def template_beyond(template: NameTemplate, part: int) -> np.ndarray:
    """Parts that hang on a part, itself among them, (K,) bool."""
    beyond = np.zeros(len(template.parts), bool)
    beyond[part] = True
    for k in range(part + 1, len(template.parts)):
        beyond[k] = beyond[template.parents[k]]
    return beyond


def _unsided(parts: frozenset[int], template: NameTemplate) -> frozenset[str]:
    return frozenset(template.parts[p] for p in parts)


def _side(parts: frozenset[int], template: NameTemplate) -> str:
    """The one side on which all parts are; "": in the middle, or both."""
    sides = {template.sides[p] for p in parts}
    return sides.pop() if len(sides) == 1 else ""


def _name(parts: frozenset[int], template: NameTemplate, *, sides_known: bool) -> str | None:
    """What parts in one body are called together; None: too many to be one thing."""
    left = list(dict.fromkeys(template.parts[p] for p in sorted(parts)))
    words = []
    for group, members in template.groups.items():
        if len(members) > 1 and set(members) <= set(left):
            words.append((left.index(members[0]), group))
            left = [p if p not in members else "" for p in left]
    words += [(i, p) for i, p in enumerate(left) if p]
    if not words or len(words) > MOST_WORDS:
        return None
    return _with_side("_".join(word for _, word in sorted(words)), _side(parts, template), known=sides_known)


def _with_side(name: str, side: str, *, known: bool) -> str:
    return name if not side else f"{name}_{side if known else 'ab'[SIDES.index(side)]}"


def _numbered(names: dict[int, str], sizes: np.ndarray) -> dict[int, str]:
    """Names of which each stands once: the largest bearer has it, the others get it with a number."""
    seen = Counter[str]()
    result = {}
    for number in sorted(names, key=lambda n: (-sizes[n], n)):
        seen[names[number]] += 1
        count = seen[names[number]]
        result[number] = names[number] if count == 1 else f"{names[number]}_{count}"
    return dict(sorted(result.items()))
