"""The command `geomocap info`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from geomocap.cli.arguments import MetresPerUnit, Workers
from geomocap.cli.console import console
from geomocap.cli.foreign_calibrations import foreign_calibration
from geomocap.cli.settings_options import with_file_of_options
from geomocap.inspection import Description, describe
from geomocap.inspection.calibrations import describe_rig


@with_file_of_options
def info(
    path: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="Capture, run, truth, calibration of any tool, motion file, or scans."),
    ],
    metres_per_unit: MetresPerUnit = 1.0,
    workers: Workers = None,
) -> None:
    """Say what a capture, run, calibration, truth, motion file or scans hold, what is wrong, and what is doubtful.

    The exit status is 1 if something is wrong.
    """
    rig = foreign_calibration(path, metres_per_unit)
    if rig is None:
        told = describe(path, metres_per_unit)
    else:
        told = Description(path, "calibration")
        describe_rig(rig, told)
    console.print(f"{told.path}: {told.kind}")
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for what, value in told.facts:
        table.add_row(f"  {what}", value)
    if told.facts:
        console.print(table)
    for problem in told.problems:
        console.print(f"wrong: {problem}", markup=False)
    for doubt in told.doubts:
        console.print(f"doubtful: {doubt}", markup=False)
    if not told.problems and not told.doubts:
        console.print("nothing wrong with it")
    raise typer.Exit(1 if told.problems else 0)
