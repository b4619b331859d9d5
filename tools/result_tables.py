"""Tables of measured figures as data: one TOML file a table, each row with its commit, seed, command and date.

A file holds `title`, `order`, `about` and `notes` (Markdown before and after the table), `columns`, and `rows`:

    columns = [{label = "capture", cell = "{name}"}, {label = "error (mm)", cell = "{joint_error_mm:.0f}"}]

    [measured]                      # of every row that doesn't say its own commit
    commit = "4acc148"
    seed = 0
    date = 2026-11-23
    command = "python -m tests.benchmarks.quality FOLDER"

    [[rows]]
    name = "man walking, 30 fps"
    joint_error_mm = 17

`cell` is a format string over the row's figures. `readme` names the rows, and columns by their labels, that the README
shows.
"""

from __future__ import annotations

import subprocess
import tomllib
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import tomli_w

import geomocap
from geomocap.files.atomic import write_text

MEASURED = ("commit", "seed", "date", "command")
ROOT = Path(__file__).parent.parent


@dataclass(frozen=True)
class ResultTable:
    """A table of measured figures.

    Attributes
    ----------
    path : Path
    values : dict
        What the file holds.
    """

    path: Path
    values: dict[str, Any]

    def __post_init__(self) -> None:
        for row in self.values["rows"]:
            for key in ("name", *MEASURED):
                if key not in self.row(row):
                    raise ValueError(f"{self.path}: row {row.get('name', row)} says no {key}")

    def row(self, row: dict[str, Any]) -> dict[str, Any]:
        """Return a row with where it came from; one that says its own commit says all of it."""
        return row if "commit" in row else {**self.values.get("measured", {}), **row}

    def cells(self, row: dict[str, Any], columns: list[dict[str, str]]) -> list[str]:
        """Return the cells of a row as the table shows them."""
        return [column["cell"].format(**self.row(row)) for column in columns]

    def with_rows(self, rows: list[dict[str, Any]]) -> ResultTable:
        """Return the table with these rows in the place of those of the same names; new names come last."""
        new = {row["name"]: row for row in rows}
        old = [new.pop(row["name"], row) for row in self.values["rows"]]
        return ResultTable(self.path, {**self.values, "rows": [*old, *new.values()]})

    def write(self) -> None:
        """Write the file whole or not at all."""
        write_text(self.path, tomli_w.dumps(self.values, multiline_strings=True))


def read_table(path: Path) -> ResultTable:
    """Read a table of figures."""
    return ResultTable(path, tomllib.loads(path.read_text(encoding="utf-8")))


def read_tables(folder: Path) -> list[ResultTable]:
    """Read all tables of a folder, in their order."""
    return sorted((read_table(p) for p in folder.glob("*.toml")), key=lambda t: (t.values["order"], t.path.name))


def measured_now(command: str, seed: int = 0) -> dict[str, Any]:
    """Say where a row that is measured now comes from; a commit with changes on top is marked by a plus sign."""

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True).stdout.strip()

    changed = "+" if git("status", "--porcelain", "--untracked-files=no", "--", "geomocap", "data_tools") else ""
    commit = git("rev-parse", "--short=7", "HEAD") or f"of version {geomocap.__version__}"
    return {"commit": commit + changed, "seed": seed, "date": date.today(), "command": command}
