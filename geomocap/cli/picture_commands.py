"""Commands that make pictures: review, render."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from geomocap.cli.arguments import ExistingRun, Wait, Workers
from geomocap.cli.console import console
from geomocap.cli.progress_bars import progress_bars
from geomocap.cli.reports import capture_of, existing_run, review_run, tell_faults, tell_results, working
from geomocap.cli.settings_options import with_file_of_options
from viz.picture_files import render_file


@with_file_of_options
def review(run: ExistingRun, workers: Workers = None, wait: Wait = False) -> None:
    """Make the pictures and the report of a run anew, from its files."""
    opened = existing_run(run)
    with working(run, wait), progress_bars() as progress:
        tell_faults(opened)
        opened.renew("review", review_run(opened, capture_of(opened), progress))
    tell_results(run)


@with_file_of_options
def render(
    geometry: Annotated[
        Path, typer.Argument(metavar="GEOMETRY", help="Mesh, point cloud or voxel grid: PLY, PCD, OBJ, STL, GLB …")
    ],
    picture: Annotated[
        Path | None, typer.Argument(metavar="PICTURE.png", help="Picture to write; beside the file if not given.")
    ] = None,
    up: Annotated[Literal["x", "y", "z"], typer.Option("--up", help="World axis that points up.")] = "z",
    workers: Workers = None,
) -> None:
    """Draw any geometry from four sides into a PNG, without a screen."""
    console.print(f"picture: {render_file(geometry, picture, up)}")
