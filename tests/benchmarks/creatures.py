"""Made-up subjects with known joints, unlike a person: what holds for these was tuned to none of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_tools.asset import AnimatedAsset, Pose
from data_tools.figure import Part, assemble, figure
from data_tools.solids import box, capsule, cylinder, ellipsoid

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def runner(speed: float = 2.5, cycle: float = 0.9, duration: float = 3.0) -> AnimatedAsset:
    """Make the built-in figure run forwards at so many metres a second, a double step in `cycle` seconds."""
    still = figure(duration=cycle)

    def pose(time: float | None) -> Pose:
        there = still.pose(None if time is None else time % cycle)
        moved = there.asset_from_joint.copy()
        moved[:, 1, 3] -= speed * (time or 0.0)
        return Pose(moved)

    return replace(still, name="runner", pose=pose, duration=duration).standing()


def spider(duration: float = 2.0) -> AnimatedAsset:
    """Make a trunk, an abdomen and eight legs of two links: 18 bodies."""
    brown, dark, leg = (0.6, 0.45, 0.3), (0.45, 0.35, 0.3), (0.7, 0.6, 0.4)
    parts = [
        Part("trunk", "", (0, 0, 0.3), (ellipsoid((0.11, 0.14, 0.07), (0, 0, 0)),), brown, ((Z, 0, 10, 1, 0.0),)),
        Part("abdomen", "trunk", (0, 0.13, 0), (ellipsoid((0.13, 0.18, 0.11), (0, 0.17, 0.03)),), dark,
             ((X, 8, 14, 1, 0.5), (Z, 0, 16, 1, 1.8))),
    ]  # fmt: skip
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for k in range(4):
            phase = np.pi * (k + (sign > 0)) + 0.3 * k
            spread = sign * (-50 + 33 * k)
            parts += [
                Part(f"{side}_femur_{k}", "trunk", (sign * 0.09, -0.08 + 0.055 * k, 0), (capsule(0.28, (0.03, 0.024)),),
                     leg, ((Z, spread, 16, 1, phase), (Y, sign * -115, 13, 1, phase + 1.2))),
                Part(f"{side}_tibia_{k}", f"{side}_femur_{k}", (0, 0, -0.3), (capsule(0.36, (0.022, 0.014)),),
                     brown, ((Y, sign * 85, 24, 1, phase + 2.0),)),
            ]  # fmt: skip
    return assemble("spider", parts, duration).standing()


def snake(links: int = 10, duration: float = 2.0) -> AnimatedAsset:
    """Make a chain of equal links along which a wave runs."""
    parts = []
    for k in range(links):
        size = 0.05 * (1.2 - 0.06 * k)
        parts.append(
            Part(
                f"link_{k}", f"link_{k - 1}" if k else "", (0, 0.16, 0) if k else (0, -0.8, 0.08),
                (ellipsoid((size, 0.095, size), (0, 0.08, 0)),), (0.5 + 0.04 * (k % 2), 0.65, 0.35),
                ((Z, 0, 27, 1, -0.8 * k), (X, 0, 5, 2, -0.5 * k)),
            )
        )  # fmt: skip
    return assemble("snake", parts, duration).standing()


def fan(duration: float = 2.0) -> AnimatedAsset:
    """Make a stand, a head that swings to and fro, and a rotor of three blades before it: 3 bodies."""
    turned = [np.deg2rad(120 * k) for k in range(3)]
    blades = tuple(ellipsoid((0.08, 0.012, 0.08), (0.11 * np.cos(a), -0.02, 0.11 * np.sin(a))) for a in turned)
    parts = [
        Part("stand", "", (0, 0, 0), (cylinder(0.16, 0.02, 2), box((-0.03, -0.03, 0), (0.03, 0.03, 0.7))),
             (0.6, 0.6, 0.65)),
        Part("head", "stand", (0, 0, 0.72), (ellipsoid((0.09, 0.13, 0.09), (0, 0, 0.06)),), (0.75, 0.6, 0.4),
             ((Z, 0, 45, 1, 0.0),)),
        Part("rotor", "head", (0, -0.16, 0.06), (cylinder(0.04, 0.03, 1), *blades), (0.45, 0.55, 0.75),
             ((Y, 0, 170, 1, 0.9),)),
    ]  # fmt: skip
    return assemble("fan", parts, duration).standing()


def doll(duration: float = 1.5, limb_bones: int = 1) -> AnimatedAsset:
    """Make a doll with a soft trunk that bends, one skin over hips and chest: 7 bodies.

    The skin follows both bones by parts that sum to 1, 12 cm to both sides of the waist. With `limb_bones` = 2 its
    elbows and knees are soft too, 5 cm to both sides: 11 bodies. With 0 there are no limbs: 3 bodies.
    """
    cloth, skin = (0.5, 0.6, 0.7), (0.8, 0.65, 0.5)
    parts = [
        Part("hips", "", (0, 0, 0.86), (ellipsoid((0.17, 0.12, 0.4), (0, 0, 0.25), rings=31),), cloth,
             ((Z, 0, 15, 1, 0.0),)),
        Part("chest", "hips", (0, 0, 0.25), (), cloth, ((X, 10, 28, 1, 1.0), (Z, 0, 22, 1, 2.2))),
        Part("head", "chest", (0, 0, 0.4), (ellipsoid((0.09, 0.11, 0.13), (0, 0, 0.13)),), skin,
             ((Z, 0, 32, 1, 0.7), (X, 0, 15, 1, 2.9))),
    ]  # fmt: skip
    sides = (("left", 1.0, 0.0), ("right", -1.0, np.pi)) if limb_bones else ()
    for side, sign, phase in sides:
        arm, leg = f"{side}_arm", f"{side}_leg"
        parts += [
            Part(arm, "chest", (sign * 0.16, 0, 0.26), (ellipsoid((0.06, 0.06, 0.31), (0, 0, -0.27), rings=41),), skin,
                 ((Y, -sign * 45, 18, 1, phase + 0.6), (X, 6, 40, 1, phase + 0.2))),
            Part(leg, "hips", (sign * 0.1, 0, -0.02), (ellipsoid((0.085, 0.085, 0.44), (0, 0, -0.38), rings=41),),
                 cloth, ((Y, -sign * 9, 6, 1, phase), (X, -16, 34, 1, phase + np.pi))),
        ]  # fmt: skip
        if limb_bones == 2:
            parts += [
                Part(f"{side}_forearm", arm, (0, 0, -0.28), (), skin, ((X, -50, 40, 1, phase + 1.1),)),
                Part(f"{side}_shank", leg, (0, 0, -0.4), (), cloth, ((X, 42, 34, 1, phase + 2.0),)),
            ]
    soft = {part.name: 0.12 if part.name == "chest" else 0.05 for part in parts if not part.solids}
    return _softened(assemble("doll", parts, duration), parts, soft).standing()


def _softened(asset: AnimatedAsset, parts: list[Part], soft: dict[str, float]) -> AnimatedAsset:
    """Share the skin of a parent with the bones along its z, over so many metres to both sides of their joints."""
    index = {part.name: k for k, part in enumerate(parts)}
    place = np.zeros((len(parts), 3))
    for k, part in enumerate(parts):
        place[k] = np.array(part.offset) + (place[index[part.parent]] if part.parent else 0.0)
    weights, owner = asset.slot_weights.copy(), asset.slot_weights.argmax(axis=1)
    for name, half in soft.items():
        child = index[name]
        parent, joint = index[parts[child].parent], parts[child].offset[2]
        own = owner == parent
        beyond = (asset.bind_vertices[own, 2] - joint) * np.sign(joint)
        weights[own, child] = np.clip(beyond / (2 * half) + 0.5, 0.0, 1.0)
        weights[own, parent] = 1.0 - weights[own, child]
    from_bind = asset.slot_from_bind.copy()
    from_bind[:, :3, 3] = -place
    bound = asset.bind_vertices + place[owner]
    return replace(asset, bind_vertices=bound, slot_weights=weights, slot_from_bind=from_bind)
