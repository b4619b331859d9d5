"""Which package imports which, read from the sources: `python -m tests.arrows` prints the list."""

from __future__ import annotations

import ast
from collections.abc import Collection
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("geomocap", "data_tools", "viz")


@dataclass(frozen=True)
class Source:
    """A module with what it imports and which public classes it defines."""

    name: str
    file: Path
    imports: frozenset[str]
    classes: tuple[str, ...]

    @property
    def room(self) -> str:
        return room_of(self.name)


def room_of(module: str) -> str:
    """Name the room of a module: package or lone module of `geomocap`; data_tools and viz are one each."""
    first, *rest = module.split(".")
    return rest[0] if first == "geomocap" and rest else first


def sources(root: Path = ROOT) -> list[Source]:
    """Read all modules of the three packages."""
    files = {_module(file, root): file for package in PACKAGES for file in sorted((root / package).rglob("*.py"))}
    return [_read(name, file, files.keys()) for name, file in files.items()]


def arrows(found: list[Source]) -> dict[tuple[str, str], list[str]]:
    """Imports from one room to another, with the modules that do so."""
    pairs: dict[tuple[str, str], list[str]] = {}
    for source in found:
        for target in sorted(source.imports):
            if target.split(".")[0] in PACKAGES and room_of(target) != source.room:
                pairs.setdefault((source.room, room_of(target)), []).append(f"{source.name} → {target}")
    return pairs


def circle(pairs: set[tuple[str, str]]) -> list[str]:
    """Rooms of one circle of arrows, in its order; empty if there is none."""
    sorter: TopologicalSorter[str] = TopologicalSorter()
    for start, end in pairs:
        sorter.add(start, end)
    try:
        sorter.prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def _module(file: Path, root: Path) -> str:
    parts = file.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _read(name: str, file: Path, modules: Collection[str]) -> Source:
    tree = ast.parse(file.read_text())
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {module if module in modules else node.module for module in inner}
    classes = tuple(n.name for n in tree.body if isinstance(n, ast.ClassDef) and not n.name.startswith("_"))
    return Source(name, file, frozenset(found), classes)


def main() -> None:
    pairs = arrows(sources())
    for start in sorted({start for start, _ in pairs}):
        print(f"{start} → {', '.join(sorted(end for first, end in pairs if first == start))}")
    print("circle: " + (" → ".join(circle(set(pairs))) or "none"))


if __name__ == "__main__":
    main()
