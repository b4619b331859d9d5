"""BVH (Biovision hierarchy): written and read.

Axes y up, metres (or centimetres), degrees, tab-indented. Channels, as every ROOT and JOINT states them:
`Zrotation Xrotation Yrotation`, so R = Rz Rx Ry (parent from node); nodes that move have `Xposition Yposition
Zposition` before them. Positions are measured in the parent's axes and replace the offset, as Blender and MotionBuilder
understand them; the root's offset is zero, so that readers which add the two agree as well.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from geomocap.export.conventions import BVH, Axis, Convention
from geomocap.export.export_errors import MotionError
from geomocap.export.motion_text import LARGEST, ends_early, read_motion_text
from geomocap.export.motion_tree import MotionTree
from geomocap.files.atomic import write_text
from geomocap.model.rotations import rotation_about, zxy_angles

MOST_JOINTS = 10_000  # hands and faces included, subjects have a few hundred
ROTATION_CHANNELS = ("Zrotation", "Xrotation", "Yrotation")
POSITION_CHANNELS = ("Xposition", "Yposition", "Zposition")
DECIMALS = 6


def write_bvh(path: Path, motion: MotionTree, *, unit: Literal["m", "cm"] = "m") -> None:
    """Write a motion as BVH, whole or not at all.

    Parameters
    ----------
    path : Path
    motion : MotionTree
    unit : "m" or "cm"
        BVH has no place for its unit: who opens the file has to know it.
    """
    write_text(path, bvh_text(motion.converted(Convention(BVH.up, unit))))


def bvh_text(motion: MotionTree) -> str:
    """Return the BVH of a motion that already is in the file's axes and unit."""
    lines = ["HIERARCHY"]
    _write_node(motion, 0, 0, lines)
    order = _depth_first(motion, 0)
    angles = np.rad2deg(zxy_angles(motion.rotations))
    columns = []
    for n in order:
        if n == 0 or motion.moving[n]:
            columns.append(motion.translations[:, n])
        columns.append(angles[:, n])
    values = np.round(np.concatenate(columns, axis=1), DECIMALS) + 0.0  # no negative zeros
    form = " ".join([f"%.{DECIMALS}f"] * values.shape[1])
    lines += ["MOTION", f"Frames: {motion.n_frames}", f"Frame Time: {1 / motion.fps:.10f}"]
    lines += [form % tuple(row) for row in values.tolist()]
    return "\n".join(lines) + "\n"


def _depth_first(motion: MotionTree, node: int) -> list[int]:
    order, stack = [], [node]
    while stack:
        n = stack.pop()
        order.append(n)
        stack.extend(reversed(motion.children(n)))
    return order


def _write_node(motion: MotionTree, node: int, depth: int, lines: list[str]) -> None:
    tabs = "\t" * depth
    positioned = node == 0 or motion.moving[node]
    channels = (*POSITION_CHANNELS, *ROTATION_CHANNELS) if positioned else ROTATION_CHANNELS
    offset = np.zeros(3) if node == 0 else motion.offsets[node]
    lines += [
        f"{tabs}{'ROOT' if node == 0 else 'JOINT'} {motion.names[node]}",
        f"{tabs}{{",
        f"{tabs}\tOFFSET {_numbers(offset)}",
        f"{tabs}\tCHANNELS {len(channels)} {' '.join(channels)}",
    ]
    children = motion.children(node)
    for child in children:
        _write_node(motion, child, depth + 1, lines)
    if not children:
        tip = np.nan_to_num(motion.tips[node])
        lines += [f"{tabs}\tEnd Site", f"{tabs}\t{{", f"{tabs}\t\tOFFSET {_numbers(tip)}", f"{tabs}\t}}"]
    lines.append(f"{tabs}}}")


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.{DECIMALS}f}" for v in (np.round(values, DECIMALS) + 0.0).tolist())


@dataclass
class _Parsed:
    """What the HIERARCHY part says."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[list[float]] = field(default_factory=list)
    channels: list[list[str]] = field(default_factory=list)
    tips: dict[int, list[float]] = field(default_factory=dict)


def read_bvh(path: Path, *, up: Axis = "y", unit: Literal["m", "cm", "mm"] = "m") -> MotionTree:
    """Read a BVH of any program: any channel order, any axes.

    Parameters
    ----------
    path : Path
    up : "x", "y" or "z"
        The file's axis that points up, which BVH can't say.
    unit : "m", "cm" or "mm"
        The file's unit, which BVH can't say.

    Returns
    -------
    MotionTree
        Metres, in the file's axes. Several ROOTs hang on a node `origin`.

    Raises
    ------
    MotionError
        If the file is no BVH, broken off, or holds something that is no number.
    """
    text = read_motion_text(path)
    if ends_early(text):
        raise MotionError(f"{path}: its last number is shorter than the others and has no line end; it was cut off")
    head, *rest = re.split(r"^\s*MOTION\s*$", text, maxsplit=1, flags=re.MULTILINE)
    if not head.lstrip().startswith("HIERARCHY") or not rest:
        raise MotionError(f"{path}: no BVH, it lacks HIERARCHY or MOTION; export it again")
    parsed = _parse_hierarchy(head.split(), path)
    values, frame_time = _parse_motion(rest[0], sum(map(len, parsed.channels)), path)
    return _to_motion(parsed, values, 1 / frame_time, up, Convention(up, unit).scale, path)


def _parse_hierarchy(tokens: list[str], path: Path) -> _Parsed:
    parsed, stack = _Parsed(), [-1]
    i = 1
    last = -1
    end_site = False
    try:
        while i < len(tokens):
            word = tokens[i]
            if word in ("ROOT", "JOINT"):
                last = len(parsed.names)
                parsed.names.append(tokens[i + 1])
                parsed.parents.append(stack[-1])
                parsed.offsets.append([0.0, 0.0, 0.0])
                parsed.channels.append([])
                i += 2
            elif word == "End":
                end_site = True
                i += 2
            elif word == "{":
                stack.append(stack[-1] if end_site else last)
                i += 1
            elif word == "}":
                stack.pop()
                end_site = False
                i += 1
            elif word == "OFFSET":
                offset = [float(x) for x in tokens[i + 1 : i + 4]]
                if len(offset) != 3 or not all(abs(x) < LARGEST for x in offset):
                    raise MotionError(f"{path}: OFFSET {' '.join(tokens[i + 1 : i + 4])} is no place; export it again")
                if end_site:
                    parsed.tips[stack[-1]] = offset
                else:
                    parsed.offsets[last] = offset
                i += 4
            elif word == "CHANNELS":
                n = int(tokens[i + 1])
                parsed.channels[last] = tokens[i + 2 : i + 2 + n]
                i += 2 + n
            else:
                raise MotionError(f"{path}: {word!r} in the HIERARCHY; expected JOINT, End Site, OFFSET or CHANNELS")
    except (ValueError, IndexError):
        raise MotionError(
            f"{path}: the HIERARCHY is damaged near {' '.join(tokens[i : i + 4])!r}; export it again"
        ) from None
    if len(parsed.names) > MOST_JOINTS:
        raise MotionError(f"{path}: {len(parsed.names):,} joints; expected {MOST_JOINTS} at the most")
    if len(stack) != 1 or not parsed.names:
        raise MotionError(f"{path}: the HIERARCHY's braces don't close, or it has no ROOT; export it again")
    known = {*ROTATION_CHANNELS, *POSITION_CHANNELS}
    for name, channels in zip(parsed.names, parsed.channels, strict=True):
        if not known.issuperset(channels):
            raise MotionError(f"{path}: {name} has channels {' '.join(channels)}; expected Xposition … Zrotation")
    twice = sorted({n for n in parsed.names if parsed.names.count(n) > 1})
    if twice:
        raise MotionError(f"{path}: the name {twice[0]} stands for two joints; give each its own")
    return parsed


def _parse_motion(text: str, n_channels: int, path: Path) -> tuple[np.ndarray, float]:
    lines = [line for line in text.splitlines() if line.strip()]
    try:
        n_frames = int(lines[0].split(":")[1])
        frame_time = float(lines[1].split(":")[1])
    except (ValueError, IndexError):
        raise MotionError(f"{path}: MOTION has no Frames: and Frame Time:; export it again") from None
    if not (np.isfinite(frame_time) and frame_time > 0):
        raise MotionError(f"{path}: Frame Time is {frame_time} s; expected a positive number")
    try:
        values = np.array(" ".join(lines[2:]).split(), dtype=float)
    except ValueError as error:
        raise MotionError(f"{path}: MOTION holds something that is no number ({error})") from None
    if n_frames < 1 or len(values) != n_frames * n_channels:
        raise MotionError(
            f"{path}: {n_frames} frames of {n_channels} channels are {n_frames * n_channels} numbers, "
            f"but the file holds {len(values)}; it was cut off or edited"
        )
    if not np.isfinite(values).all():
        frame = int(np.argmin(np.isfinite(values))) // n_channels
        raise MotionError(f"{path}: frame {frame} holds NaN or infinity; BVH has no gaps, fill them before exporting")
    return values.reshape(n_frames, n_channels), frame_time


def _to_motion(parsed: _Parsed, values: np.ndarray, fps: float, up: Axis, scale: float, path: Path) -> MotionTree:
    T, n = len(values), len(parsed.names)
    offsets = np.array(parsed.offsets)
    rotations = np.tile(np.eye(3), (T, n, 1, 1))
    translations = np.tile(offsets, (T, 1, 1))
    moving = np.zeros(n, bool)
    column = 0
    for j, channels in enumerate(parsed.channels):
        for name in channels:
            axis = "XYZ".index(name[0])
            if name.endswith("position"):
                translations[:, j, axis] = values[:, column]
                moving[j] = True
            else:
                rotations[:, j] = rotations[:, j] @ rotation_about(axis, np.deg2rad(values[:, column]))
            column += 1
    tips = np.full((n, 3), np.nan)
    for j, tip in parsed.tips.items():
        tips[j] = tip
    names, parents = list(parsed.names), np.array(parsed.parents)
    if (parents < 0).sum() > 1:
        names = ["origin", *names]
        parents = np.concatenate([[-1], parents + 1])
        offsets = np.concatenate([np.zeros((1, 3)), offsets])
        rotations = np.concatenate([np.tile(np.eye(3), (T, 1, 1, 1)), rotations], axis=1)
        translations = np.concatenate([np.zeros((T, 1, 3)), translations], axis=1)
        moving, tips = np.concatenate([[False], moving]), np.concatenate([np.full((1, 3), np.nan), tips])
    return MotionTree(
        names=tuple(names),
        parents=parents,
        offsets=offsets / scale,
        rotations=rotations,
        translations=translations / scale,
        moving=moving,
        tips=tips / scale,
        bodies=np.full(len(names), -1),
        joints=np.full(len(names), -1),
        fps=fps,
        up=up,
    )
