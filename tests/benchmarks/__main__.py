"""Run all benchmarks, or those named, and print one table: `python -m tests.benchmarks [NAME …]`."""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table


def _time(seconds: float) -> str:
    if math.isnan(seconds):
        return ""
    return f"{seconds * 1000:.2f} ms" if seconds < 1 else f"{seconds:.2f} s"


def main() -> None:
    found = sorted(p.stem.removeprefix("bench_") for p in Path(__file__).parent.glob("bench_*.py"))
    table = Table("task", "geomocap", "beside it", "its time", "ratio", "goal", "note")
    for name in sys.argv[1:] or found:
        for row in importlib.import_module(f"tests.benchmarks.bench_{name}").benchmark():
            ratio = row.competitor_seconds / row.seconds
            table.add_row(
                row.task,
                _time(row.seconds),
                row.competitor,
                _time(row.competitor_seconds),
                "" if math.isnan(ratio) else f"{ratio:.1f} ×",
                row.goal,
                row.note,
            )
    Console(width=200).print(table)


if __name__ == "__main__":
    main()
