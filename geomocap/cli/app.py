"""The commands: each opens folders, makes a job, calls the library and shows progress."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import geomocap
from geomocap import pipeline
from geomocap.cli import capture_commands as captures
from geomocap.cli.calibrate_command import calibrate
from geomocap.cli.evaluate_command import evaluate
from geomocap.cli.execution import Scheduler, Workers
from geomocap.cli.export_command import export
from geomocap.cli.info import info
from geomocap.cli.jobs import CaptureFolder, ExistingRun, RunFolder, capture_job, scans_job
from geomocap.cli.keypoint_command import keypoints
from geomocap.cli.progress_bars import progress_bars
from geomocap.cli.reports import capture_of, console, review_job, review_run, tell_clouds, tell_results
from geomocap.cli.settings_options import with_file_of_options, with_settings
from geomocap.config import Config
from geomocap.files.run import Run
from viz.picture_files import render_file

app = typer.Typer(
    name="geomocap",
    help="Motion capture without markers and without a body model, from the geometry alone.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        console.print(f"geomocap {geomocap.__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Motion capture without markers and without a body model, from the geometry alone."""


Fps = Annotated[float, typer.Option("--fps", min=0.001, help="Scans per second.")]
BODIES = ("segmentation", "skeleton", "nodes", "motion_bodies", "motion_skeleton", "refinement", "following")
ModelFile = Annotated[
    Path | None,
    typer.Option(
        "--model", metavar="FILE.npz", help="Model of the subject, model.npz of another run: it is followed instead."
    ),
]
Pictures = Annotated[bool, typer.Option(help="Make review pictures and the report.")]


@app.command()
@with_settings("silhouettes")
def silhouettes(
    capture: CaptureFolder, run: RunFolder, config: Config, workers: Workers = None, scheduler: Scheduler = None
) -> None:
    """Cut the subject out of all images."""
    with capture_job(capture, run, config, workers, scheduler) as job:
        pipeline.silhouettes(job)


@app.command()
@with_settings("silhouettes", "carving")
def voxels(
    capture: CaptureFolder, run: RunFolder, config: Config, workers: Workers = None, scheduler: Scheduler = None
) -> None:
    """Carve the surface voxels of all frames, silhouettes first where they are missing."""
    with capture_job(capture, run, config, workers, scheduler) as job:
        pipeline.voxels(job)


@app.command()
@with_settings("silhouettes", "carving", "cloud")
def cloud(
    capture: CaptureFolder, run: RunFolder, config: Config, workers: Workers = None, scheduler: Scheduler = None
) -> None:
    """Measure the surface by least squares matching: a dense point cloud for each frame."""
    with capture_job(capture, run, config, workers, scheduler) as job:
        pipeline.clouds(job)
    tell_clouds(job.run)


@app.command()
@with_settings("silhouettes", "carving", "tracking", "filters", "smoothing")
def track(
    capture: CaptureFolder, run: RunFolder, config: Config, workers: Workers = None, scheduler: Scheduler = None
) -> None:
    """Follow points of the surface through all frames: trajectories with velocities and accelerations."""
    with capture_job(capture, run, config, workers, scheduler) as job:
        pipeline.tracks(job)


@app.command()
@with_settings("scans", *BODIES, "export")
def segment(
    scans: Annotated[
        Path, typer.Argument(metavar="SCANS", help="Folder of scans, or one file (PLY PCD OBJ STL GLB NPZ).")
    ],
    run: RunFolder,
    config: Config,
    fps: Fps = 30.0,
    model: ModelFile = None,
    pictures: Pictures = True,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Segment any sequence of scans into rigid bodies, joints and motion; one scan gets its ellipsoids."""
    with scans_job(scans, run, fps, config, workers, scheduler, model) as job:
        key = pipeline.motion_files(job, "scans")
        if pictures:
            review_job(job, key)
    tell_results(run)


@app.command()
@with_settings("silhouettes", "carving", "cloud", "tracking", "filters", "smoothing", *BODIES, "export")
def run(
    capture: CaptureFolder,
    run: RunFolder,
    config: Config,
    source: Annotated[Literal["voxels", "cloud"], typer.Option("--source", help="Geometry to work from.")] = "voxels",
    model: ModelFile = None,
    pictures: Pictures = True,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Do everything: from a capture to bodies, skeleton, motion files and report.

    A run that was stopped goes on where it was; stages whose inputs and settings have not changed are not done again.

    With a model of the subject, saved as model.npz by a run of another sequence, bodies and joints are not looked for:
    the model is found in this sequence and followed through it.

    Example: `geomocap run CAPTURE RUN --carving.resolution 192`
    """
    with capture_job(capture, run, config, workers, scheduler, model) as job:
        key = pipeline.motion_files(job, source)
        if pictures:
            review_job(job, key)
    if source == "cloud":
        tell_clouds(job.run)
    tell_results(run)


@app.command()
@with_file_of_options
def review(run: ExistingRun, workers: Workers = None) -> None:
    """Make the pictures and the report of a run anew, from its files."""
    with progress_bars() as progress:
        review_run(Run(run), capture_of(Run(run)), progress)
    tell_results(run)


@app.command()
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


app.command()(captures.synthesize)
app.command("import")(captures.import_)
app.command()(captures.demo)
app.command()(calibrate)
app.command("convert-calibration")(captures.convert)
app.command()(keypoints)
app.command()(export)
app.command()(evaluate)
app.command()(info)
