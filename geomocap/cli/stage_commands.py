"""The commands that are made of stages: each opens folders, makes a job, calls the library and shows progress.

What does the work is imported when a command is called, so that its help comes at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from geomocap.cli.arguments import CaptureFolder, ModelFile, Pictures, RunFolder, Scheduler, Wait, Workers
from geomocap.cli.settings_options import with_settings
from geomocap.config import Config
from geomocap.settings import LEAST_FPS, MOST_FPS

Fps = Annotated[float, typer.Option("--fps", min=LEAST_FPS, max=MOST_FPS, help="Scans per second.")]
BODIES = ("segmentation", "skeleton", "nodes", "motion_bodies", "motion_skeleton", "refinement", "following")


@with_settings("cameras", "silhouettes")
def silhouettes(
    capture: CaptureFolder,
    run: RunFolder,
    config: Config,
    workers: Workers = None,
    scheduler: Scheduler = None,
    wait: Wait = False,
) -> None:
    """Cut the subject out of all images."""
    from geomocap import pipeline
    from geomocap.cli.jobs import capture_job

    with capture_job(capture, run, config, workers, scheduler, wait=wait) as job:
        pipeline.silhouettes(job)


@with_settings("cameras", "silhouettes", "carving")
def voxels(
    capture: CaptureFolder,
    run: RunFolder,
    config: Config,
    workers: Workers = None,
    scheduler: Scheduler = None,
    wait: Wait = False,
) -> None:
    """Carve the surface voxels of all frames, silhouettes first where they are missing."""
    from geomocap import pipeline
    from geomocap.cli.jobs import capture_job

    with capture_job(capture, run, config, workers, scheduler, wait=wait) as job:
        pipeline.voxels(job)


@with_settings("cameras", "silhouettes", "carving", "cloud")
def cloud(
    capture: CaptureFolder,
    run: RunFolder,
    config: Config,
    workers: Workers = None,
    scheduler: Scheduler = None,
    wait: Wait = False,
) -> None:
    """Measure the surface by least squares matching: a dense point cloud for each frame."""
    from geomocap import pipeline
    from geomocap.cli.jobs import capture_job
    from geomocap.cli.reports import tell_clouds

    with capture_job(capture, run, config, workers, scheduler, wait=wait) as job:
        pipeline.clouds(job)
    tell_clouds(job.run)


@with_settings("cameras", "silhouettes", "carving", "tracking", "windows", "filters", "smoothing")
def track(
    capture: CaptureFolder,
    run: RunFolder,
    config: Config,
    workers: Workers = None,
    scheduler: Scheduler = None,
    wait: Wait = False,
) -> None:
    """Follow points of the surface through all frames: trajectories with velocities and accelerations."""
    from geomocap import pipeline
    from geomocap.cli.jobs import capture_job

    with capture_job(capture, run, config, workers, scheduler, wait=wait) as job:
        pipeline.tracks(job)


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
    wait: Wait = False,
) -> None:
    """Segment any sequence of scans into rigid bodies, joints and motion; one scan gets its ellipsoids."""
    from geomocap import pipeline
    from geomocap.cli.jobs import scans_job
    from geomocap.cli.reports import review_job, tell_results

    with scans_job(scans, run, fps, config, workers, scheduler, model, wait=wait) as job:
        key = pipeline.motion_files(job, "scans")
        if pictures:
            review_job(job, key)
    tell_results(run)


@with_settings(
    "cameras", "silhouettes", "carving", "cloud", "tracking", "windows", "filters", "smoothing", *BODIES, "export"
)
def run(
    capture: CaptureFolder,
    run: RunFolder,
    config: Config,
    preview: Annotated[
        bool, typer.Option("--preview", help="A quick look: some frames a second, small images, the same report.")
    ] = False,
    source: Annotated[Literal["voxels", "cloud"], typer.Option("--source", help="Geometry to work from.")] = "voxels",
    model: ModelFile = None,
    pictures: Pictures = True,
    workers: Workers = None,
    scheduler: Scheduler = None,
    wait: Wait = False,
) -> None:
    """Do everything: from a capture to bodies, skeleton, motion files and report.

    A run that was stopped goes on where it was; stages whose inputs and settings have not changed are not done again.

    With a model of the subject, saved as model.npz by a run of another sequence, bodies and joints are not looked for:
    the model is found in this sequence and followed through it.

    With --preview every n-th frame is used, so that 12 a second are left, images are reduced to about 320 pixels, and
    there are fewer patches and voxels: it tells in little time whether cameras, silhouettes and bodies come out right.

    Example: `geomocap run CAPTURE RUN --resolution 192 --bodies 15`
    """
    from geomocap import pipeline
    from geomocap.cli.jobs import capture_job
    from geomocap.cli.reports import review_job, tell_clouds, tell_results

    with capture_job(capture, run, config, workers, scheduler, model, wait=wait, preview=preview) as job:
        key = pipeline.motion_files(job, source)
        if pictures:
            review_job(job, key)
    if source == "cloud":
        tell_clouds(job.run)
    tell_results(run)
