"""How the clouds of a run came about, `cloud/000000.json`."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from geomocap.errors import RunError
from geomocap.files.atomic import write_text
from geomocap.files.run import Run
from geomocap.reading import read_json


@dataclass(frozen=True)
class CloudRecord:
    """What a run says of its clouds.

    Attributes
    ----------
    frames : int
    points : int
        Of all frames.
    reasons : dict
        What became of all cells and seeds, in words, summed over the frames.
    warnings : dict
        Warnings, and the number of frames that have them or the same with other figures.
    """

    frames: int
    points: int
    reasons: dict[str, int]
    warnings: dict[str, int]


def read_cloud_record(run: Run) -> CloudRecord | None:
    """Sum up `cloud/*.json` of a run; None if there are none.

    Raises
    ------
    RunError
        If a file is damaged.
    """
    reasons, warnings = Counter[str](), Counter[str]()
    first: dict[str, str] = {}
    files = sorted((run.path / "cloud").glob("[0-9]*.json"))
    points = 0
    for file in files:
        record = read_json(file, RunError)
        try:
            points += int(record["points"])
            reasons.update({str(k): int(v) for k, v in record["reasons"].items()})
            for warning in record["warnings"]:
                warnings[first.setdefault(re.sub(r"[\d.]+ ?(px|%)", "", warning), warning)] += 1
        except (ValueError, KeyError, AttributeError, TypeError, OverflowError):
            raise RunError(f"{file}: damaged; delete it and run again") from None
    return CloudRecord(len(files), points, dict(reasons), dict(warnings)) if files else None


def write_cloud_record(run: Run, frame: int, points: int, reasons: Mapping[str, int], warnings: Sequence[str]) -> None:
    """Write of a frame how many points were measured, why others were not, and what looks wrong."""
    record = {"points": points, "reasons": dict(reasons), "warnings": list(warnings)}
    write_text(run.path / "cloud" / f"{frame:06d}.json", json.dumps(record, indent=1), lasting=False)
