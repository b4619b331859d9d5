"""Subjects made of a template: its parts as bodies, walking, with any of its joints left out."""

from __future__ import annotations

from collections.abc import Collection
from importlib import resources
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.model.hierarchy import Hierarchy
from geomocap.model.skeleton import Skeleton, bone_fixed_skeleton
from geomocap.naming.name_templates import NameTemplate, read_template


def figure(
    template: NameTemplate,
    *,
    without: Collection[tuple[str, str]] = (),
    turn: float = 0.0,
    speed: float = 1.0,
    size: float = 1.7,
    frames: int = 24,
    mirrored: bool = False,
) -> tuple[Skeleton, list[str]]:
    """A skeleton that walks and swings its parts by a third of what they can, and the true name of each body.

    Parts in `without`, given with their sides, belong to their parents' bodies. `turn` is about the vertical, radians.
    """
    count = len(template.parts)
    labels = [f"{p}_{s}" if s else p for p, s in zip(template.parts, template.sides, strict=True)]
    body = np.zeros(count, int)
    kept: list[int] = [0]
    for k in range(1, count):
        if (template.parts[k], template.sides[k]) in without:
            body[k] = body[template.parents[k]]
        else:
            body[k] = len(kept)
            kept.append(k)
    pairs = np.array([(body[template.parents[k]], body[k]) for k in kept[1:]], np.int32).reshape(-1, 2)
    flip = np.array([1.0, -1.0, 1.0]) if mirrored else np.ones(3)
    yaw = Rotation.from_euler("z", turn).as_matrix()

    def placed(points: np.ndarray) -> np.ndarray:
        return size * (points * flip) @ yaw.T

    joints = placed(template.joint_places[kept[1:]])
    ends = np.where(np.isfinite(template.tips), (template.centers + template.tips) / 2, template.centers)
    middle = placed(
        np.array([np.average(ends[body == b], axis=0, weights=template.surfaces[body == b]) for b in range(len(kept))])
    )
    hierarchy = Hierarchy(0, pairs)
    t = np.arange(frames) / frames
    local = np.tile(np.eye(3), (frames, len(kept), 1, 1))
    for b, k in enumerate(kept[1:], start=1):
        phase = {"left": 0.0, "right": np.pi, "": 0.5}[template.sides[k]]
        angle = template.mobility[k] / 3 * np.sin(2 * np.pi * t + phase)
        local[:, b] = yaw @ Rotation.from_rotvec(angle[:, None] * [0.0, 1.0, 0.0]).as_matrix() @ yaw.T
    origin = np.concatenate([middle[:1], joints])
    offsets = np.tile(origin, (frames, 1, 1))
    offsets[:, 1:] -= origin[pairs[:, 0]]
    offsets[:, 0] += speed * t[:, None] * placed(np.array([1.0, 0, 0]))
    world, origins = hierarchy.forward_kinematics(local, offsets)
    centers = origins + np.einsum("tbij,bj->tbi", world, middle - origin)
    skeleton = bone_fixed_skeleton(hierarchy, joints, world, origins[:, 1:], centers, middle, 30.0)
    return skeleton, [labels[k] for k in kept]


def with_a_thigh_in_two(folder: Path, cut: float, knee: float = 0.285) -> tuple[Skeleton, list[str]]:
    """A person whose left thigh is two bodies, parted at a height; heights in shares of the person's."""
    text = (resources.files("geomocap.naming") / "templates" / "human.toml").read_text()
    top, rest = text.split("[parts.thigh]")
    thigh, rest = rest.split("[parts.shank]")
    piece = (
        f"[parts.thigh_low]\npair = true\nparent = 'thigh'\njoint = [0.04, 0.06, {cut}]\n"
        f"center = [0.03, 0.06, {(cut + knee) / 2}]\nsurface = 0.5\nmobility = 0.5\n\n"
    )
    low = rest.replace('parent = "thigh"', 'parent = "thigh_low"', 1).replace("0.285]", f"{knee}]", 1)
    (folder / "long.toml").write_text(f"{top}[parts.thigh]{thigh}{piece}[parts.shank]{low}")
    return figure(read_template(folder / "long.toml"), without=[("thigh_low", "right")])
