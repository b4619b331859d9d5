"""Sets of names that other programs know, in place of the templates' own."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib import resources
from typing import Literal

from geomocap.naming.found_names import FoundNames

NameSetName = Literal["plain", "opensim", "mixamo", "humanik", "coco"]


@dataclass(frozen=True)
class NameSet:
    """What a program calls the parts of a template and their joints.

    Attributes
    ----------
    template : str
    bodies, joints : dict of part with side (thigh_left) to name
    origins : dict of the same to name
        The program's body in whose origin the joint lies by which a part begins, where the program has such models.
    """

    template: str
    bodies: dict[str, str]
    joints: dict[str, str]
    origins: dict[str, str]


def read_name_set(name: str) -> NameSet:
    """Read a set that comes with the package."""
    text = (resources.files("geomocap.naming") / "name_sets" / f"{name}.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    return NameSet(table["template"], table.get("bodies", {}), table.get("joints", {}), table.get("origins", {}))


def renamed(found: FoundNames, name_set: NameSetName) -> FoundNames:
    """Return found names in another program's words.

    A body of several parts gets the name of that one which is nearest to the trunk: its joint is where the bone begins.
    Sided names need left and right; what the set has no word for keeps its plain name.

    Parameters
    ----------
    found : FoundNames
    name_set : str
    """
    if name_set == "plain" or found.template is None:
        return found
    words = read_name_set(name_set)
    if words.template != found.template.name:
        return found
    first = {body: min(parts) for body, parts in found.parts.items()}
    bodies = found.bodies | _words(((b, first[b]) for b in found.whole), words.bodies, found)
    joints = found.joints | _words(found.joint_parts.items(), words.joints, found)
    return replace(found, bodies=bodies, joints=joints)


def _words(numbers: Iterable[tuple[int, int]], words: dict[str, str], found: FoundNames) -> dict[int, str]:
    """Names of numbers with a part each; a name is given once."""
    template = found.template
    result: dict[int, str] = {}
    if template is None:
        return result
    for number, part in numbers:
        side = template.sides[part]
        name = words.get(f"{template.parts[part]}_{side}" if side else template.parts[part])
        if name is not None and name not in result.values() and (found.sides_known or not side):
            result[number] = name
    return result
