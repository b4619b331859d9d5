"""The command `geomocap evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table

from geomocap.cli.arguments import Workers
from geomocap.cli.console import console
from geomocap.cli.progress_bars import progress_bars
from geomocap.cli.reports import capture_of, tell_faults
from geomocap.cli.settings_options import with_options_of
from geomocap.errors import RunError
from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.result import Evaluation
from geomocap.evaluation.result_check import check_run
from geomocap.evaluation.run_evaluation import evaluate as evaluate_run
from geomocap.files.atomic import write_text
from geomocap.files.check_file import read_self_check
from geomocap.files.result_schemas import skeleton_gaps
from geomocap.files.results import SKELETON, read_skeleton, read_warnings
from geomocap.files.run import Run
from viz.evaluation_report import evaluation_report


@with_options_of(EvaluationSettings)
def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    settings: EvaluationSettings,
    truth: Annotated[
        Path | None,
        typer.Argument(
            metavar="[TRUTH]",
            help="Truth folder of a synthetic capture, or a .c3d, .trc or .bvh file; without it the run is held "
            "against its own silhouettes.",
        ),
    ] = None,
    matches: Annotated[
        Path | None,
        typer.Option("--matches", metavar="FILE.toml", help='Pairs that belong together: joint = "marker".'),
    ] = None,
    unit: Annotated[Literal["m", "cm", "mm"], typer.Option("--unit", help="Unit of a BVH truth.")] = "m",
    up: Annotated[
        Literal["x", "y", "z"] | None,
        typer.Option("--up", help="Axis of a motion file that points up."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="FILE.html", help="Page with plots and error pictures.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures as JSON.")] = None,
    workers: Workers = None,
) -> None:
    """Compare a run with the truth: lengths in mm unless a name says otherwise, `%h` is per cent of the height.

    Without a truth the run is held against what its cameras saw, and a verdict says whether to trust it.

    Example: `geomocap evaluate RUN walk.c3d --align true --find_offset true --report evaluation.html`
    """
    tell_faults(Run(run))
    if truth is None:
        _without_truth(run, json_file)
        return
    with progress_bars() as progress:
        result = evaluate_run(run, truth, settings, matches=matches, unit=unit, up=up, progress=progress)
        if report is not None:
            evaluation_report(report, result, run, truth, progress=progress)
    for gap in skeleton_gaps(read_skeleton(Run(run))) if Run(run).has(SKELETON) else ():
        console.print(f"note: {gap}")
    for name, value in result.rounded().items():
        console.print(f"{name}: {value}", markup=False)
    _print_matches(result)
    if json_file is not None:
        write_text(json_file, json.dumps(result.rounded(), indent=1))
    if report is not None:
        console.print(f"report: {report}")


def _without_truth(folder: Path, json_file: Path | None) -> None:
    """Print how well a run agrees with its own silhouettes, and what follows from that."""
    if not folder.is_dir():
        raise RunError(f"{folder}: no such run folder")
    run = Run(folder)
    found = read_self_check(run)
    if found is None:
        capture = capture_of(run)
        found = None if capture is None else check_run(run, capture)
    if found is None:
        raise RunError(
            f"{folder}: has no silhouettes or no model to compare; name a truth, or make them by `geomocap run`"
        )
    verdict, reasons = found.verdict(tuple(read_warnings(run)))
    for name, value in found.figures.items():
        console.print(f"{name}: {round(value, 4)}", markup=False)
    console.print(f"verdict: {verdict}" + "".join(f"\n  {reason}" for reason in reasons), markup=False)
    if json_file is not None:
        write_text(json_file, json.dumps({**found.figures, "verdict": verdict, "reasons": list(reasons)}, indent=1))


def _print_matches(result: Evaluation) -> None:
    if not result.matches:
        return
    table = Table("found", "true", "mean mm", "95 % mm", "frames", box=None, padding=(0, 2, 0, 0))
    for column in table.columns[2:]:
        column.justify = "right"
    for m in sorted(result.matches, key=lambda m: m.mean_mm):
        table.add_row(m.found, m.true, f"{m.mean_mm:.1f}", f"{m.p95_mm:.1f}", str(m.frames))
    console.print(table)
