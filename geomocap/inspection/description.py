"""The result of looking at a file or folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Description:
    """What something is, what it holds, what is wrong with it, and what is doubtful.

    Attributes
    ----------
    path : Path
    kind : str
        "capture", "run", "calibration", "truth", "motion file" or "scans".
    facts : list of (what, value)
    problems : list of str
        One line each; empty if nothing is wrong.
    doubts : list of str
        One line each: what may be as it should.
    """

    path: Path
    kind: str
    facts: list[tuple[str, str]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def fact(self, what: str, value: object) -> None:
        """Add a fact."""
        self.facts.append((what, str(value)))

    def problem(self, what: object) -> None:
        """Add something that is wrong, as one line, and once."""
        _add_line(self.problems, what)

    def doubt(self, what: object) -> None:
        """Add something that is doubtful, as one line, and once."""
        _add_line(self.doubts, what)


def _add_line(lines: list[str], what: object) -> None:
    line = " ".join(str(what).split())
    if line not in lines:
        lines.append(line)


def count(n: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun: 1 frame, 2 frames."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def shortened(names: list[str], most: int = 12) -> str:
    """Return names in a row, cut after `most`."""
    more = f" … and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
