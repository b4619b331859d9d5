"""Subjects made in code, so that a demonstration needs no file: an articulated figure and a machine of hard parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.asset import AnimatedAsset, Pose
from data_tools.solids import Solid, box, capsule, cylinder, ellipsoid


@dataclass(frozen=True)
class Part:
    """A rigid part on a joint that swings about fixed axes of its parent.

    Attributes
    ----------
    name, parent : str
        `parent` is "" for the root.
    offset : (3,) float
        The joint in the parent's axes, metres.
    solids : tuple of Solid
        In the joint's own axes.
    color : (3,) float
        0 … 1.
    swings : tuple of (axis (3,), middle, amplitude, cycles, phase)
        Turns about the axis by middle + amplitude · sin(2π cycles t/T + phase); angles in degrees. Applied in
        order, the first outermost.
    """

    name: str
    parent: str
    offset: tuple[float, float, float]
    solids: tuple[Solid, ...]
    color: tuple[float, float, float]
    swings: tuple[tuple[tuple[float, float, float], float, float, int, float], ...] = ()


def figure(height: float = 1.75, duration: float = 2.0) -> AnimatedAsset:
    """Make an articulated figure of 16 bodies in a motion in which every joint turns at least 25°.

    Parameters
    ----------
    height : float
        Height at the clip's begin, metres.
    duration : float
        Length of the clip, seconds; it repeats without a jump.
    """
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    skin, shirt, trousers, shoe = (0.85, 0.65, 0.5), (0.45, 0.6, 0.75), (0.6, 0.55, 0.4), (0.5, 0.35, 0.3)
    parts = [
        Part("hips", "", (0, 0, 0.98), (ellipsoid((0.175, 0.12, 0.13), (0, 0, 0.0)),), trousers, ((z, 0, 18, 1, 0.0),)),
        Part("chest", "hips", (0, 0, 0.13), (ellipsoid((0.2, 0.13, 0.24), (0, 0, 0.19)),), shirt,
             ((z, 0, 17, 1, 2.0), (x, -6, 14, 1, 1.0))),
        Part("head", "chest", (0, 0, 0.44), (ellipsoid((0.085, 0.105, 0.13), (0, -0.01, 0.15)),
                                             capsule(0.1, (0.05, 0.055))), skin,
             ((z, 0, 28, 1, 0.7), (x, 0, 12, 1, 2.9))),
    ]  # fmt: skip
    for side, sign, phase in (("left", 1.0, 0.0), ("right", -1.0, np.pi)):
        parts += [
            Part(f"{side}_upper_arm", "chest", (sign * 0.2, 0, 0.33), (capsule(0.26, (0.062, 0.05)),), shirt,
                 ((y, -sign * 38, 16, 1, phase + 0.6), (x, 6, 44, 1, phase + 0.2))),
            Part(f"{side}_forearm", f"{side}_upper_arm", (0, 0, -0.29), (capsule(0.23, (0.048, 0.036)),), skin,
                 ((x, -52, 38, 1, phase + 1.1),)),
            Part(f"{side}_hand", f"{side}_forearm", (0, 0, -0.27), (ellipsoid((0.045, 0.028, 0.085), (0, 0, -0.07)),),
                 skin, ((x, 0, 34, 1, phase + 2.0),)),
            Part(f"{side}_thigh", "hips", (sign * 0.105, 0, -0.05), (capsule(0.38, (0.09, 0.062)),), trousers,
                 ((y, -sign * 9, 5, 1, phase), (x, -16, 36, 1, phase + np.pi))),
            Part(f"{side}_shank", f"{side}_thigh", (0, 0, -0.43), (capsule(0.36, (0.06, 0.042)),), trousers,
                 ((x, 40, 34, 1, phase + np.pi / 2 + 0.4),)),
            Part(f"{side}_foot", f"{side}_shank", (0, 0, -0.40), (ellipsoid((0.047, 0.125, 0.042), (0, -0.07, -0.03)),),
                 shoe, ((x, 2, 24, 1, phase + 2.4),)),
        ]  # fmt: skip
    # One more body than limbs need, off the symmetry, so that nothing can rely on a person's plan
    parts.append(Part("tail", "hips", (0, 0.1, 0.02), (capsule(0.4, (0.05, 0.028)),), (0.8, 0.75, 0.3),
                      ((x, 62, 22, 1, 0.4), (y, 0, 30, 1, 1.9))))  # fmt: skip
    return assemble("figure", parts, duration).standing(height)


def mechanism(duration: float = 3.0) -> AnimatedAsset:
    """Make a machine of hard parts on hinges: turning base, swinging booms, a spinning wheel and a gripper.

    Its hinges are known: `truth_extras` holds `hinge_joints` (H,), the joints' numbers, and `hinge_axes` (H, 3),
    their axes in the parent joint's axes.
    """
    y, z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    steel, paint, signal, dark = (0.62, 0.65, 0.7), (0.75, 0.6, 0.25), (0.75, 0.35, 0.28), (0.42, 0.45, 0.5)
    parts = [
        Part("stand", "", (0, 0, 0), (box((-0.38, -0.3, 0), (0.38, 0.3, 0.22)),), steel),
        Part("turret", "stand", (0, 0, 0.22), (cylinder(0.2, 0.14, 2), box((-0.08, -0.14, 0.1), (0.08, 0.14, 0.34))),
             paint, ((z, 0, 70, 1, 0.0),)),
        Part("boom", "turret", (0, 0, 0.34), (box((-0.07, -0.06, -0.06), (0.07, 0.06, 0.66)),), signal,
             ((y, 22, 32, 1, 0.8),)),
        Part("arm", "boom", (0, 0, 0.66), (box((-0.055, -0.05, -0.05), (0.055, 0.05, 0.5)),), steel,
             ((y, 68, 36, 2, 2.1),)),
        Part("wrist", "arm", (0, 0, 0.5), (cylinder(0.07, 0.09, 2),), dark, ((z, 0, 80, 1, 1.4),)),
        Part("upper_jaw", "wrist", (0.05, 0, 0.09), (box((-0.02, -0.045, 0), (0.035, 0.045, 0.2)),), paint,
             ((y, 22, 22, 2, 0.0),)),
        Part("lower_jaw", "wrist", (-0.05, 0, 0.09), (box((-0.035, -0.045, 0), (0.02, 0.045, 0.2)),), paint,
             ((y, -22, 22, 2, np.pi),)),
        Part("wheel", "stand", (0, -0.36, 0.26), (cylinder(0.2, 0.04, 1), box((-0.03, -0.06, -0.17), (0.03, 0, 0.17))),
             dark, ((y, 0, 100, 1, 0.3),)),
        Part("flap", "stand", (0.38, 0, 0.2), (box((0, -0.22, -0.025), (0.34, 0.22, 0.025)),), signal,
             ((y, -20, 35, 1, 2.6),)),
    ]  # fmt: skip
    hinged = [k for k, part in enumerate(parts) if part.swings]
    extras = {
        "hinge_joints": np.array(hinged),
        "hinge_axes": np.array([parts[k].swings[0][0] for k in hinged], dtype=float),
    }
    return assemble("mechanism", parts, duration, extras).standing()


def assemble(
    name: str, parts: list[Part], duration: float, truth_extras: dict[str, np.ndarray] | None = None
) -> AnimatedAsset:
    """Join rigid parts, parents before children, into an animated asset."""
    index = {part.name: k for k, part in enumerate(parts)}
    parents = np.array([index.get(part.parent, -1) for part in parts])
    offsets = np.array([part.offset for part in parts], dtype=float)

    def pose(time: float | None) -> Pose:
        transforms = np.tile(np.eye(4), (len(parts), 1, 1))
        for k, part in enumerate(parts):
            local = np.eye(4)
            local[:3, 3] = offsets[k]
            for axis, middle, amplitude, cycles, phase in part.swings:
                swing = 0.0 if time is None else np.sin(2 * np.pi * cycles * time / duration + phase)
                turn = np.deg2rad(middle + amplitude * swing)
                local[:3, :3] = local[:3, :3] @ Rotation.from_rotvec(turn * np.array(axis)).as_matrix()
            transforms[k] = transforms[parents[k]] @ local if parents[k] >= 0 else local
        return Pose(transforms)

    vertices, faces, uv, groups, owner = [], [], [], [], []
    count = 0
    for k, part in enumerate(parts):
        for solid in part.solids:
            vertices.append(solid.vertices)
            faces.append(solid.faces + count)
            groups.append(solid.normals_group + count)
            uv.append(solid.uv)
            owner.append(np.full(len(solid.vertices), k))
            count += len(solid.vertices)
    joint = np.concatenate(owner)
    triangles = np.concatenate(faces)
    return AnimatedAsset(
        name=name,
        bind_vertices=np.concatenate(vertices),
        faces=triangles,
        normals_group=np.concatenate(groups),
        uv=np.concatenate(uv),
        vertex_colors=np.array([part.color for part in parts], dtype=float)[joint],
        face_textures=np.zeros(len(triangles), dtype=np.int64),
        textures=(_stripes(),),
        slot_weights=np.eye(len(parts))[joint],
        slot_joints=np.arange(len(parts)),
        slot_from_bind=np.tile(np.eye(4), (len(parts), 1, 1)),
        joint_names=tuple(part.name for part in parts),
        joint_parents=parents,
        pose=pose,
        duration=duration,
        truth_extras=truth_extras or {},
    )


def _stripes() -> np.ndarray:
    """Draw a soft check, so that parts are not plain: (64, 64, 3) uint8."""
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    check = 0.82 + 0.18 * np.sin(2 * np.pi * 3 * u / 64) * np.sin(2 * np.pi * 4 * v / 64)
    return np.repeat((255 * check)[:, :, None], 3, axis=2).astype(np.uint8)
