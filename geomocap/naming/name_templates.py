"""Templates of known skeletons: parts with their joints, places, surfaces; each a plain TOML file.

name = "human"
[parts.thorax]                 # the one part without `parent` is the root
parent = "pelvis"
joint_name = "back"            # what the joint to the parent is called
joint = [0.0, 0.0, 0.63]       # its place: forward, left, up; any unit
center = [0.0, 0.0, 0.73]      # of the part's surface
tip = [0.0, 0.0, 1.0]          # farthest point of a part at the end of a limb
surface = 18                   # its fraction of the surface; any unit
mobility = 0.3                 # how far it usually turns in its joint, radians
pair = true                    # there are two, written down for the left one
[groups]                       # what several parts in one body are called
trunk = ["pelvis", "thorax"]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.model.hierarchy import Hierarchy
from geomocap.reading import read_toml

MIRROR = np.array([1.0, -1.0, 1.0])
SIDES = ("left", "right")


class NamingError(GeomocapError):
    """A template of names that can't be read or used."""


@dataclass(frozen=True)
class NameTemplate:
    """K parts in a tree; part k > 0 hangs on its parent by joint k - 1.

    Attributes
    ----------
    name : str
    parts : tuple of str
        Without sides; a parent comes before its children.
    sides : tuple of str
        "left", "right" or "" for each part.
    joints : tuple of str
        What the joint of each part to its parent is called; "" for the root.
    parents : (K,) int
        -1 for the root, which is part 0.
    joint_places, centers, tips : (K, 3) float
        Forward, left, up; NaN where there is none.
    surfaces, mobility : (K,) float
        Shares that sum to one; radians.
    groups : mapping of str to tuple of str
    upright : bool
        Whether up in the world is up in the template.
    """

    name: str
    parts: tuple[str, ...]
    sides: tuple[str, ...]
    joints: tuple[str, ...]
    parents: np.ndarray
    joint_places: np.ndarray
    centers: np.ndarray
    tips: np.ndarray
    surfaces: np.ndarray
    mobility: np.ndarray
    groups: Mapping[str, tuple[str, ...]]
    upright: bool = True

    @cached_property
    def hierarchy(self) -> Hierarchy:
        """The tree of parts."""
        return Hierarchy(0, np.array([(p, k) for k, p in enumerate(self.parents.tolist()) if p >= 0], np.int32))

    @cached_property
    def mirrored(self) -> np.ndarray:
        """The part of the other side for each part, (K,) int; the part itself in the middle."""
        names = list(zip(self.parts, self.sides, strict=True))
        other = {"left": "right", "right": "left", "": ""}
        return np.array([names.index((part, other[side])) for part, side in names])


def built_in_templates() -> list[str]:
    """Names of the templates that come with the package."""
    folder = resources.files("geomocap.naming") / "templates"
    return sorted(Path(file.name).stem for file in folder.iterdir() if file.name.endswith(".toml"))


def read_template(name: str | Path) -> NameTemplate:
    """Read a template: one that comes with the package by its name, or a TOML file.

    Raises
    ------
    NamingError
        If there is no such template, or it can't be used.
    """
    known = built_in_templates()
    if str(name) in known:
        path = Path(str(resources.files("geomocap.naming") / "templates" / f"{name}.toml"))
    else:
        path = Path(name)
        if not path.exists():
            raise NamingError(f"{name}: no such template; expected one of {', '.join(known)}, or a TOML file")
    return _template(read_toml(path, NamingError), str(name))


def is_template(name: str | Path) -> bool:
    """Tell whether a name or file is a template, not a list of names; a file that can't be read is none."""
    if str(name) in built_in_templates():
        return True
    try:
        return "parts" in read_toml(Path(name), NamingError)
    except NamingError:
        return False


def _template(table: dict[str, Any], where: str) -> NameTemplate:
    listed = table.get("parts")
    if not isinstance(listed, dict) or not all(isinstance(p, dict) for p in listed.values()):
        raise NamingError(f"{where}: has no parts; expected tables [parts.NAME]")
    rows: list[tuple[str, str, dict[str, Any]]] = []
    for part, values in listed.items():
        unknown = set(values) - {"parent", "joint_name", "joint", "center", "tip", "surface", "mobility", "pair"}
        if unknown:
            raise NamingError(f"{where}: part {part} has the unknown key {min(unknown)}")
        parent = values.get("parent")
        if (parent is None) != (not rows) or (parent is not None and parent not in {r[0] for r in rows}):
            raise NamingError(f"{where}: part {part} needs a parent that stands before it; only the first has none")
        rows += [(part, side, values) for side in (SIDES if values.get("pair") else ("",))]
    index = {(part, side): k for k, (part, side, _) in enumerate(rows)}
    parents = np.array(
        [-1 if "parent" not in v else index.get((v["parent"], s), index.get((v["parent"], ""), -1)) for _, s, v in rows]
    )
    if (parents[1:] < 0).any():
        raise NamingError(f"{where}: a part in the middle can't hang on one of a pair")
    surfaces = np.array([_number(v, "surface", p, where) for p, _, v in rows])
    groups = {g: tuple(parts) for g, parts in table.get("groups", {}).items()}
    for group, parts in groups.items():
        if not set(parts) <= set(listed):
            raise NamingError(f"{where}: group {group} names parts that are not there")
    return NameTemplate(
        name=str(table.get("name", Path(where).stem)),
        parts=tuple(p for p, _, _ in rows),
        sides=tuple(s for _, s, _ in rows),
        joints=tuple("" if k == 0 else str(v.get("joint_name", p)) for k, (p, _, v) in enumerate(rows)),
        parents=parents,
        joint_places=_places(rows, "joint", where, first=1),
        centers=_places(rows, "center", where),
        tips=_places(rows, "tip", where, first=len(rows)),
        surfaces=surfaces / surfaces.sum(),
        mobility=np.array([0.0 if k == 0 else _number(v, "mobility", p, where) for k, (p, _, v) in enumerate(rows)]),
        groups=groups,
        upright=bool(table.get("upright", True)),
    )


def _number(values: dict[str, Any], key: str, part: str, where: str) -> float:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise NamingError(f"{where}: part {part} has {key} = {value!r}; expected a number above 0")
    return float(value)


def _places(rows: list[tuple[str, str, dict[str, Any]]], key: str, where: str, first: int = 0) -> np.ndarray:
    """Places of all parts, (K, 3); those from `first` on must be there."""
    places = np.full((len(rows), 3), np.nan)
    for k, (part, side, values) in enumerate(rows):
        if key not in values:
            if k >= first:
                raise NamingError(f"{where}: part {part} has no {key}; expected [forward, left, up]")
            continue
        try:
            place = np.array(values[key], float)
        except (TypeError, ValueError):
            place = np.zeros(0)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise NamingError(f"{where}: part {part} has {key} = {values[key]!r}; expected [forward, left, up]")
        places[k] = place * (MIRROR if side == "right" else 1.0)
    return places
