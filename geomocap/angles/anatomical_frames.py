"""Anatomical axes of a person's bodies, from joint centres and from the axes about which knees and elbows really turn.

Axes are those of the International Society of Biomechanics: X forward, Y up along the body, Z to the right (Wu et al.
2002, J. Biomech. 35, 543; Wu et al. 2005, J. Biomech. 38, 981). Where those recommendations use bony landmarks that a
surface doesn't show, the axis is the joint's own: Z of thigh and shank is the knee's axis, Z of upper arm and forearm
the elbow's. A part whose end has no joint of its own, because its neighbour is in one body with it, points to the
middle of its surface, as far as the same part of the other side reaches. A foot's X is along its sole, in the plane in
which the knee bends. Hands and the head have the axes of their neighbour in the first frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from geomocap.model.rotations import relative_turns, turn_angles
from geomocap.model.skeleton import Skeleton
from geomocap.naming.found_names import FoundNames
from geomocap.skeleton.hinges import main_axis

LEAST_TURN = np.deg2rad(15.0)  # a joint that turns less doesn't show its axis
TURNS = {"shank": ("thigh", -1.0), "forearm": ("upper_arm", 1.0)}  # which way it bends, about Z of its parent
NEIGHBOUR = {"foot": "shank", "hand": "forearm", "head": "thorax"}


@dataclass(frozen=True)
class AnatomicalFrames:
    """Axes of the parts that were found.

    Attributes
    ----------
    bodies : dict of part with side (thigh_left) to number of the body that holds it
    axes : dict of the same to (3, 3) float
        X, Y, Z as columns, in the body's own axes, which are the world's in frame 0.
    """

    bodies: dict[str, int]
    axes: dict[str, np.ndarray]


def anatomical_frames(skeleton: Skeleton, found: FoundNames) -> AnatomicalFrames | None:
    """Return the axes of a person's bodies; None for other subjects, or if left and right are not told."""
    template = found.template
    if template is None or template.name != "human" or not found.sides_known or found.from_world is None:
        return None
    labels = [f"{p}_{s}" if s else p for p, s in zip(template.parts, template.sides, strict=True)]
    bodies = {labels[p]: b for b in sorted(found.whole) for p in found.parts[b]}
    joints: dict[str, np.ndarray] = {}
    for j, p in sorted(found.joint_parts.items(), key=lambda one: -found.joint_confidence[one[0]]):
        joints.setdefault(labels[p], skeleton.joint_positions[0, j])
    forward, left, up = found.from_world
    world = np.stack([forward, up, -left], axis=1)
    axes: dict[str, np.ndarray] = {}
    hips, shoulders = (_pair(joints, part) for part in ("thigh", "upper_arm"))
    low = joints.get("thorax", None if hips is None else hips.mean(axis=0))
    high = joints.get("head", None if shoulders is None else shoulders.mean(axis=0))
    if "pelvis" in bodies:
        top = joints.get("thorax", high)
        long = up if hips is None or top is None else top - hips.mean(axis=0)
        axes["pelvis"] = world if hips is None else axes_of(long, hips[1] - hips[0], keep="across")
    if "thorax" in bodies:
        long = up if low is None or high is None else high - low
        axes["thorax"] = axes_of(long, world[:, 2] if shoulders is None else shoulders[1] - shoulders[0], keep="long")
    for outer, (inner, bend) in TURNS.items():
        for side in ("left", "right"):
            names = f"{inner}_{side}", f"{outer}_{side}"
            end = {"shank": "foot", "forearm": "hand"}[outer]
            other = {"left": "right", "right": "left"}[side]
            chain = (inner, outer, end)
            places = [joints.get(f"{part}_{side}") for part in chain]
            mirrored = [joints.get(f"{part}_{other}") for part in chain]
            _limb(skeleton, found, bodies, axes, names, places, mirrored, bend, world)
    for part, neighbour in NEIGHBOUR.items():
        for end in ("", "_left", "_right"):
            if part + end in bodies and neighbour + end in axes:
                axes[part + end] = axes[neighbour + end]
                if part == "foot" and "shank" + end in axes and found.surface is not None:
                    pieces = [b for b, held in found.parts.items() if [labels[p] for p in held] == [part + end]]
                    points = found.surface.points[np.isin(found.surface.bodies, pieces)]
                    axes[part + end] = axes_on_sole(points, joints.get(part + end), axes["shank" + end])
    return AnatomicalFrames({name: bodies[name] for name in axes}, axes)


def axes_of(long: np.ndarray, across: np.ndarray, *, keep: str) -> np.ndarray:
    """Axes X, Y, Z as columns, (3, 3): Y along `long`, Z along `across`; the one to `keep` is met exactly."""
    if keep == "long":
        y = long / np.linalg.norm(long)
        z = across - (across @ y) * y
        z /= np.linalg.norm(z)
    else:
        z = across / np.linalg.norm(across)
        y = long - (long @ z) * z
        y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def axes_on_sole(points: np.ndarray, ankle: np.ndarray | None, shank: np.ndarray) -> np.ndarray:
    """Axes X, Y, Z of a foot as columns, (3, 3): X along the sole, in the plane in which the shank swings.

    The sole is the side of the foot's outline in this plane across which it is thinnest; toes are farther from the
    ankle than the heel.

    Parameters
    ----------
    points : (N, 3) float
        On the foot.
    ankle : (3,) float, optional
        Without it, or with too few points, the axes are the shank's.
    shank : (3, 3) float
        Axes of the shank.
    """
    if ankle is None:
        return shank
    flat = (points - ankle) @ shank[:, :2]
    flat = flat[flat[:, 1] < 0]  # what is above the ankle is leg
    if len(flat) < 3 or np.linalg.matrix_rank(flat - flat[0]) < 2:
        return shank
    outline = flat[ConvexHull(flat).vertices]
    sides = np.roll(outline, -1, axis=0) - outline
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    across = np.ptp(outline @ np.column_stack([-sides[:, 1], sides[:, 0]]).T, axis=0)
    sole = sides[np.argmin(across)]
    sole = sole * (1.0 if sole @ flat.mean(axis=0) > 0 else -1.0)
    x = shank[:, :2] @ sole
    return np.stack([x, np.cross(shank[:, 2], x), shank[:, 2]], axis=1)


def _pair(joints: dict[str, np.ndarray], part: str) -> np.ndarray | None:
    """Places of a joint on the left and the right, (2, 3)."""
    both = [joints.get(f"{part}_{side}") for side in ("left", "right")]
    return np.stack([b for b in both if b is not None]) if all(b is not None for b in both) else None


def _limb(
    skeleton: Skeleton,
    found: FoundNames,
    bodies: dict[str, int],
    axes: dict[str, np.ndarray],
    names: tuple[str, str],
    places: list[np.ndarray | None],
    mirrored: list[np.ndarray | None],
    bend: float,
    world: np.ndarray,
) -> None:
    """Add the axes of a limb's upper and lower part; both have the axis of the joint between them as Z."""
    start, middle, end = places
    inner, outer = (bodies.get(name) for name in names)
    if middle is None and inner is not None and outer is not None and inner != outer:
        middle = skeleton.joint_positions[0, _last_joint(skeleton, inner, outer)]
    if inner is not None and start is not None:
        whole = middle is None or inner == outer
        down = (_middle(skeleton, found, inner, start, *mirrored[:2]) if whole else middle) - start
        across = world[:, 2]
        if outer is not None and outer != inner and middle is not None:
            tip = _middle(skeleton, found, outer, middle, *mirrored[1:]) if end is None else end
            across = _bending_axis(skeleton, inner, outer, down, tip - middle, bend, across)
            axes[names[1]] = axes_of(middle - tip, across, keep="across")
            axes[names[0]] = axes_of(-down, across, keep="across")
        else:
            axes[names[0]] = axes_of(-down, across, keep="long")


def _middle(
    skeleton: Skeleton,
    found: FoundNames,
    body: int,
    joint: np.ndarray,
    mirrored: np.ndarray | None,
    mirrored_end: np.ndarray | None,
) -> np.ndarray:
    """Middle (3,) of a body's surface in frame 0, no farther from its joint than the same part of the other side."""
    points = np.zeros((0, 3)) if found.surface is None else found.surface.points[found.surface.bodies == body]
    if mirrored is not None and mirrored_end is not None:
        near = np.linalg.norm(points - joint, axis=1) <= np.linalg.norm(mirrored_end - mirrored)
        points = points[near] if near.any() else points
    return points.mean(axis=0) if len(points) else skeleton.body_positions[0, body]


def _last_joint(skeleton: Skeleton, inner: int, outer: int) -> int:
    """The joint by which a body hangs on another, whatever lies between them."""
    pairs = skeleton.joint_bodies
    reached, before = [inner], {}
    for body in reached:
        for j in np.flatnonzero((pairs == body).any(axis=1)).tolist():
            other = int(pairs[j].sum()) - body
            if other not in reached:
                before[other] = j
                reached.append(other)
    return int(before[outer])


def _bending_axis(
    skeleton: Skeleton,
    inner: int,
    outer: int,
    down: np.ndarray,
    along: np.ndarray,
    bend: float,
    right: np.ndarray,
) -> np.ndarray:
    """Axis (3,) of a joint that bends one way only, in the axes of frame 0, to the right in a straight posture."""
    rotations = skeleton.body_rotations
    known = np.isfinite(rotations[:, [inner, outer]]).all(axis=(1, 2, 3))
    turns = relative_turns(rotations[known, inner], rotations[known, outer])
    if turn_angles(turns).max(initial=0.0) < LEAST_TURN:
        return right
    axis = main_axis(turns, np.ones(len(turns)))
    bent = np.cross(down, turns @ along).sum(axis=0)
    return axis * (1.0 if bend * (axis @ bent) > 0 else -1.0)
