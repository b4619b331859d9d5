"""Names of bodies and joints: stable ones by number, or the user's from `names.toml`.

# names.toml
thigh_left = 3            # body 3
shank_left = 5

[joints]                  # optional; a joint between named bodies is otherwise called after them
knee_left = 4
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geomocap.export.export_errors import MotionError
from geomocap.model.skeleton import body_names
from geomocap.reading import check_name, read_toml


@dataclass(frozen=True)
class Names:
    """Names given by the user.

    Attributes
    ----------
    bodies, joints : mapping of number to name
    source : str
        Where they come from, for messages.
    """

    bodies: Mapping[int, str] = field(default_factory=dict)
    joints: Mapping[int, str] = field(default_factory=dict)
    source: str = "names"

    def __post_init__(self) -> None:
        for kind in (self.bodies, self.joints):
            for name in kind.values():
                check_name(name, self.source, MotionError, "body or joint")
                if not name or any(c.isspace() or c in "{}/\\" for c in name):
                    raise MotionError(
                        f"{self.source}: {name!r} is no usable name; leave out spaces, braces and slashes"
                    )

    @classmethod
    def read(cls, path: Path) -> Names:
        """Read `names.toml`.

        Raises
        ------
        MotionError
            If the file can't be read, or a value isn't a body's number, or a number is named twice.
        """
        table = read_toml(path, MotionError)
        for key in ("joints", "bodies"):
            if not isinstance(table.get(key, {}), dict):
                raise MotionError(f"{path}: {key} is no table; write [{key}], then lines such as thigh_left = 3")
        joints = table.pop("joints", {})
        bodies = {**table.pop("bodies", {}), **table}
        return cls(_by_number(bodies, path, "body"), _by_number(joints, path, "joint"), str(path))

    def over(self, bodies: Mapping[int, str], joints: Mapping[int, str]) -> Names:
        """Return these names, and others for what they leave unnamed.

        Parameters
        ----------
        bodies, joints : mapping of number to name
            A name that is taken is left out.
        """
        more_bodies = {b: name for b, name in bodies.items() if name not in self.bodies.values()}
        more_joints = {j: name for j, name in joints.items() if name not in self.joints.values()}
        return Names({**more_bodies, **self.bodies}, {**more_joints, **self.joints}, self.source)

    def body_names(self, n: int, found: Sequence[str] | np.ndarray | None = None) -> tuple[str, ...]:
        """Return the names of `n` bodies: the user's, or the found ones, or `body00` …"""
        self._check(self.bodies, n, "body", "bodies")
        numbered = body_names(n).tolist()
        for b, name in self.bodies.items():
            if name in numbered and name != numbered[b]:  # whatever that one is called now
                raise MotionError(f"{self.source}: the name {name} stands for two things; give each its own")
        default = found if found is not None else numbered
        return _unique([self.bodies.get(b, str(default[b])) for b in range(n)], self.source)

    def joint_names(
        self, joint_bodies: np.ndarray, body_names: Sequence[str], found: Sequence[str] | np.ndarray | None = None
    ) -> tuple[str, ...]:
        """Return the names of joints: the user's, or those of the bodies that it joins where the user named any.

        Parameters
        ----------
        joint_bodies : (J, 2) int
            Parent and child body.
        body_names : sequence of str
            From `body_names`.
        found : sequence of str, optional
            Names of the joints so far.
        """
        n = len(joint_bodies)
        self._check(self.joints, n, "joint", "joints")
        names = []
        for j, (parent, child) in enumerate(joint_bodies.tolist()):
            renamed = parent in self.bodies or child in self.bodies
            default = f"joint_{body_names[parent]}_{body_names[child]}" if renamed or found is None else str(found[j])
            names.append(self.joints.get(j, default))
        return _unique(names, self.source, number_repeats=True)

    def _check(self, kind: Mapping[int, str], n: int, one: str, many: str) -> None:
        for number, name in kind.items():
            if not 0 <= number < n:
                raise MotionError(
                    f"{self.source}: {name} names {one} {number}, but there are {n} {many} (0 to {n - 1})"
                )


def _by_number(table: Mapping[str, object], path: Path, kind: str) -> dict[int, str]:
    names: dict[int, str] = {}
    for name, number in table.items():
        if isinstance(number, bool) or not isinstance(number, int):
            raise MotionError(f"{path}: {name} = {number!r}; expected the number of a {kind}, e.g. {name} = 3")
        if number in names:
            raise MotionError(f"{path}: {kind} {number} is named twice, {names[number]} and {name}")
        names[number] = name
    return names


def _unique(names: list[str], source: str, *, number_repeats: bool = False) -> tuple[str, ...]:
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        if seen[name] > 1 and not number_repeats:
            raise MotionError(f"{source}: the name {name} stands for two things; give each its own")
        result.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return tuple(result)
