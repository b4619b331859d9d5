"""What a run says of itself: what it was made from and with (`run.toml`), and how long that took (`timings.json`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from geomocap.errors import RunError
from geomocap.reading import check_entries, harmless, read_json, read_toml, shortened

RECORD, TIMINGS = "run.toml", "timings.json"
_HINT = "delete it and run again"
_TABLES = ("geomocap", "source", "versions", "config")


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and "\0" not in value


def _is_rate(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf")


def _is_preview(value: Any) -> bool:
    keys = ("every", "longest")
    return isinstance(value, dict) and all(type(value.get(k)) is int and value[k] > 0 for k in keys)


_EXPECTED: Mapping[tuple[str, str], tuple[Callable[[Any], bool], str]] = {
    ("geomocap", "version"): (_is_text, "a text"),
    ("source", "kind"): (_is_text, "a text"),
    ("source", "path"): (_is_text, "a path"),
    ("source", "from_run"): (_is_text, "a path"),
    ("source", "model"): (_is_text, "a path"),
    ("source", "fps"): (_is_rate, "a number above 0"),
    ("source", "preview"): (_is_preview, "a table with every and longest, whole numbers above 0"),
    ("source", "up"): (lambda value: value in ("x", "y", "z"), "x, y or z"),
}


def read_run_record(run: Path) -> dict[str, Any]:
    """Read `run.toml` of a run folder; what is not of the kind that a run writes is refused.

    Raises
    ------
    RunError
        If the folder is no run, or its record none that a run wrote.
    """
    file = run / RECORD
    if not file.exists():
        raise RunError(f"{run}: no run folder, it has no {RECORD}")
    record = read_toml(file, RunError, _HINT)
    check_entries(record, file, RunError, _HINT)
    if "source" not in record:
        raise RunError(f"{file}: cut off, it has no table source, as the record of a run has; {_HINT}")
    for name in _TABLES:
        if not isinstance(record.get(name, {}), dict):
            raise RunError(f"{file}: {name} is no table, as it is in the record of a run; {_HINT}")
    for (table, key), (good, expected) in _EXPECTED.items():
        if key in record.get(table, {}) and not good(value := record[table][key]):
            said = harmless(shortened(repr(value)))
            raise RunError(f"{file}: {table}.{key} is {said}; expected {expected}; {_HINT}")
    return record


def source_places(run: Path, path: Path) -> dict[str, str]:
    """Return what a run says of where its source is: from anywhere, and from the run, if both are moved together.

    A path that isn't UTF-8 can't stand in TOML as it is: of folders of such names the second may be one.
    """
    places = {"path": os.path.abspath(path), "from_run": os.path.relpath(path, run)}
    return {what: os.fsencode(place).decode("utf-8", "backslashreplace") for what, place in places.items()}


def source_path(run: Path, source: Mapping[str, Any]) -> Path:
    """Return where a run's source is: where it was, or where it lies now as seen from the run.

    Parameters
    ----------
    run : Path
    source : mapping
        The table of the run's record.
    """
    path = Path(source.get("path", ""))
    moved = [run / source["from_run"]] if "from_run" in source else []
    if not path.is_absolute():  # of older runs: from the folder where the command was given
        moved += [parent / path for parent in run.absolute().parents]
    return next((place for place in (path, *moved) if place.exists()), path)


def read_timings(run: Path) -> dict[str, dict[str, float]]:
    """Read `timings.json` of a run folder; empty if there is none that can be read."""
    try:
        found = read_json(run / TIMINGS, RunError)
        return {
            str(stage): {name: timing[name] + 0 for name in ("seconds", "items", "items_per_second")}
            for stage, timing in found.items()
        }
    except (RunError, TypeError, KeyError, AttributeError):
        return {}
