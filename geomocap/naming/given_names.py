"""Names that a user gave in a template's own words say what the bodies are, as found names do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from geomocap.model.skeleton import Skeleton
from geomocap.naming.found_names import FoundNames
from geomocap.naming.name_templates import NameTemplate

ACROSS = (
    "thigh",
    "upper_arm",
    "hind_upper_leg",
    "front_upper_leg",
    "leg",
    "wing",
)  # parts whose joints lie side by side


def with_given(
    found: FoundNames, given: Mapping[int, str], skeleton: Skeleton, up: int, templates: Sequence[NameTemplate]
) -> FoundNames:
    """Return found names in which bodies are what the user called them, where that is a word of a template.

    Parameters
    ----------
    found : FoundNames
    given : mapping of body to name
    skeleton : Skeleton
    up : int
        World axis that points up, 0 to 2.
    templates : sequence of NameTemplate
        Of these the one that was found, or else the one that has more of the names than any other.
    """
    known = [t for t in templates if found.template is None or t.name == found.template.name]
    if not known:
        return found
    template, *others = sorted(known, key=lambda t: -len(_parts(t, given)))
    own = _parts(template, given)
    if len(own) <= max((len(_parts(t, given)) for t in others), default=0):
        return found
    taken = set(own.values())
    kept = {b: p for b, p in found.parts.items() if b not in own and not taken & set(p)}
    parts = kept | {b: (k,) for b, k in own.items()}
    joint_parts = {j: k for j, k in found.joint_parts.items() if k not in taken}
    body_of = {k: b for b, held in parts.items() for k in held}
    for body, part in own.items():
        joint = _joint_to_trunk(skeleton, template, body_of, body, part)
        if joint is not None:
            joint_parts[joint] = part
    labels = _labels(template)
    sided = any(template.sides[k] for k in taken)
    heading = _heading(skeleton, template, joint_parts, up) if sided else None
    return replace(
        found,
        template=template,
        bodies={b: n for b, n in found.bodies.items() if b in kept} | {b: labels[k] for b, k in own.items()},
        joints={j: n for j, n in found.joints.items() if j in joint_parts and joint_parts[j] not in taken}
        | {j: _joint_name(template, k) for j, k in joint_parts.items() if k in taken},
        confidence={b: c for b, c in found.confidence.items() if b in kept} | dict.fromkeys(own, 1.0),
        joint_confidence={
            j: found.joint_confidence.get(j, 1.0) if k not in taken else 1.0 for j, k in joint_parts.items()
        },
        parts=parts,
        joint_parts=joint_parts,
        sides_known=found.sides_known or sided,
        from_world=found.from_world if heading is None else heading,
    )


def _labels(template: NameTemplate) -> list[str]:
    return [f"{p}_{s}" if s else p for p, s in zip(template.parts, template.sides, strict=True)]


def _joint_name(template: NameTemplate, part: int) -> str:
    side = template.sides[part]
    return f"{template.joints[part]}_{side}" if side else template.joints[part]


def _parts(template: NameTemplate, given: Mapping[int, str]) -> dict[int, int]:
    """Part of each body whose name is a word of a template."""
    labels = _labels(template)
    return {body: labels.index(name) for body, name in given.items() if name in labels}


def _joint_to_trunk(
    skeleton: Skeleton, template: NameTemplate, body_of: Mapping[int, int], body: int, part: int
) -> int | None:
    """The joint by which a body hangs on what is nearer to the trunk; None if no such part is named."""
    above = int(template.parents[part])
    while above >= 0 and body_of.get(above, body) == body:
        above = int(template.parents[above])
    if above < 0:
        return None
    hierarchy, numbers = skeleton.hierarchy.grown_from(body_of[above])
    return int(numbers[hierarchy.body_joints[body]])


def _heading(skeleton: Skeleton, template: NameTemplate, joint_parts: Mapping[int, int], up: int) -> np.ndarray | None:
    """Forward, left and up from the world's axes in the first frame, by the joints that lie side by side."""
    places = {k: skeleton.joint_positions[0, j] for j, k in joint_parts.items()}
    across = [
        places[k] - places[int(template.mirrored[k])]
        for k in places
        if template.sides[k] == "left" and template.parts[k] in ACROSS and int(template.mirrored[k]) in places
    ]
    vertical = np.eye(3)[up]
    left = np.sum(across, axis=0) if across else np.zeros(3)
    left = left - (left @ vertical) * vertical
    if np.linalg.norm(left) < 1e-6:
        return None
    left /= np.linalg.norm(left)
    return np.stack([np.cross(left, vertical), left, vertical])
