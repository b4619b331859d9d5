"""Warnings in words that a stage leaves for the report: `diagnostics.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence

from geomocap.files.atomic import write_text
from geomocap.files.run import Run

WARNINGS_FILE = "diagnostics.json"


def write_warnings(run: Run, warnings: Sequence[str]) -> None:
    """Write what the report says in its beginning."""
    write_text(run.path / WARNINGS_FILE, json.dumps({"warnings": list(warnings)}, indent=1))
