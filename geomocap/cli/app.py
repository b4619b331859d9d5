"""The commands: each opens folders, makes a job, calls the library and shows progress."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

import geomocap
from geomocap import pipeline
from geomocap.capture import Capture
from geomocap.cli.execution import Scheduler, Workers
from geomocap.cli.jobs import CaptureFolder, RunFolder, capture_job, scans_job
from geomocap.cli.progress import progress_bars
from geomocap.cli.settings_options import with_options_of, with_settings
from geomocap.config import Config
from geomocap.run import Run

app = typer.Typer(
    name="geomocap",
    help="Motion capture without markers and without a body model, from the geometry alone.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
_out = Console(highlight=False)


def _version(wanted: bool) -> None:
    if wanted:
        _out.print(f"geomocap {geomocap.__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Motion capture without markers and without a body model, from the geometry alone."""


Fps = Annotated[float, typer.Option("--fps", min=0.001, help="Scans per second.")]
Truth = Annotated[Path | None, typer.Option("--truth", metavar="DIR", help="Folder for the truth; CAPTURE_truth if not given.")]


@app.command()
@with_options_of(SynthesisSettings)
def synthesize(
    asset: Annotated[
        str, typer.Argument(metavar="ASSET", help="Animated .glb/.gltf file, or a built-in subject: figure, mechanism.")
    ],
    capture: CaptureFolder,
    settings: SynthesisSettings,
    truth: Truth = None,
    animation: Annotated[
        str | None, typer.Option("--animation", help="Name or number of the animation; the first if not given.")
    ] = None,
    workers: Workers = None,
) -> None:
    """Synthesize a multi-camera capture with ground truth from an animated glTF.

    Example: `geomocap synthesize horse.glb horse --animation Walk --cameras 8 --width 320 --height 240 --fps 15`
    """
    truth = truth or capture.with_name(capture.name + "_truth")
    with executor_for(workers, None) as executor, progress_bars() as progress:
        result = synthesize_capture(
            open_asset(asset, animation), capture, truth, settings, executor=executor, progress=progress
        )
    for note in result.notes:
        _out.print(f"note: {note}")
    _out.print(f"{capture}: {len(result.rig)} cameras, {settings.frames} frames; truth in {truth}")


@app.command("import")
def import_(
    kind: Annotated[Literal["pose2sim", "colmap"], typer.Argument(metavar="KIND", help="pose2sim or colmap.")],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="The other tool's folder.")],
    capture: CaptureFolder,
    fps: Annotated[float | None, typer.Option("--fps", min=0.001, help="Frames per second, where SOURCE doesn't say.")] = None,
) -> None:
    """Turn another tool's session into a capture.

    pose2sim: a session folder with calibration/ (Qualisys or Pose2Sim TOML) and videos/.
    colmap: a folder with sparse/ and images/<camera>/.
    """
    with progress_bars() as progress:
        notes = import_session(kind, source, capture, fps=fps, progress=progress)
    for note in notes:
        _out.print(f"note: {note}")
    opened = Capture.open(capture)
    _out.print(f"{capture}: {len(opened.cameras)} cameras, {opened.n_frames} frames at {opened.fps:g} fps")


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
@with_settings("scans", "segmentation", "skeleton", "export")
def segment(
    scans: Annotated[Path, typer.Argument(metavar="SCANS", help="Folder of scans, or one file (PLY PCD OBJ STL GLB NPZ).")],
    run: RunFolder,
    config: Config,
    fps: Fps = 30.0,
    pictures: Annotated[bool, typer.Option(help="Make review pictures and the report.")] = True,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Segment any sequence of scans into rigid bodies, joints and motion; one scan gets its ellipsoids."""
    with scans_job(scans, run, fps, config, workers, scheduler) as job:
        pipeline.motion_files(job, "scans")
        if pictures:
            review_run(job)
    _done(run)


@app.command()
@with_settings("silhouettes", "carving", "segmentation", "skeleton", "export")
def run(
    capture: CaptureFolder,
    run: RunFolder,
    config: Config,
    source: Annotated[Literal["voxels"], typer.Option("--source", help="Geometry to work from.")] = "voxels",
    pictures: Annotated[bool, typer.Option(help="Make review pictures and the report.")] = True,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Do everything: from a capture to bodies, skeleton, motion files and report.

    A run that was stopped goes on where it was; stages whose inputs and settings have not changed are not done again.

    Example: `geomocap run CAPTURE RUN --carving.resolution 192`
    """
    with capture_job(capture, run, config, workers, scheduler) as job:
        pipeline.motion_files(job, source)
        if pictures:
            review_run(job)
    _done(run)


@app.command()
def review(run: RunFolder, workers: Workers = None) -> None:
    """Make the pictures and the report of a run anew, from its files."""
    with progress_bars() as progress:
        review_files(Run(run), source_capture(Run(run)), progress=progress)
    _done(run)


@app.command()
def demo(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for capture, truth and run.")] = Path("demo"),
    workers: Workers = None,
) -> None:
    """Synthesize a small capture of the built-in figure and take it all the way to the report."""
    capture, truth, run = out / "capture", out / "truth", out / "run"
    with executor_for(workers, None) as executor, progress_bars() as progress:
        if not (capture / "capture.toml").exists():
            synthesize_capture(open_asset("figure"), capture, truth, DEMO, executor=executor, progress=progress)
    with capture_job(capture, run, Config(), workers, None) as job:
        pipeline.motion_files(job, "voxels")
        review_run(job)
    _done(run)


def _done(run: Path) -> None:
    report = run / "review" / "report.html"
    if report.exists():
        _out.print(f"report: {report}")
    motion = run / "motion.bvh"
    if motion.exists():
        _out.print(f"motion: {motion}")
