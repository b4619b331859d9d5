"""The commands that are made of stages: each opens folders, makes a job, calls the library and shows progress.

What does the work is imported when a command is called, so that its help comes at once.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from geomocap.cli.app import COMMANDS
from geomocap.cli.arguments import CaptureFolder, ModelFile, Pictures, RunFolder, Where
from geomocap.cli.settings_options import with_settings
from geomocap.config import Config
from geomocap.settings import LEAST_FPS, MOST_FPS

Fps = Annotated[float, typer.Option("--fps", min=LEAST_FPS, max=MOST_FPS, help="Scans per second.")]
BODIES = ("segmentation", "skeleton", "nodes", "motion_bodies", "motion_skeleton", "refinement", "following")


def _stage(name: str, work: str, *sections: str) -> Callable[..., None]:
    """Return the command that does a stage of a capture, after those that it needs."""

    @with_settings("cameras", "silhouettes", *sections)
    def command(capture: CaptureFolder, run: RunFolder, config: Config, where: Where) -> None:
        from geomocap import pipeline
        from geomocap.cli.jobs import capture_job
        from geomocap.cli.reports import tell_clouds

        with capture_job(capture, run, config, where) as job:
            getattr(pipeline, work)(job)
        if work == "clouds":
            tell_clouds(job.run)

    command.__doc__ = COMMANDS[name][1]
    return command


silhouettes = _stage("silhouettes", "silhouettes")
voxels = _stage("voxels", "voxels", "carving")
cloud = _stage("cloud", "clouds", "carving", "cloud")
track = _stage("track", "tracks", "carving", "tracking", "windows", "filters", "smoothing")


@with_settings("scans", *BODIES, "export")
def segment(
    scans: Annotated[
        Path, typer.Argument(metavar="SCANS", help="Folder of scans, or one file (PLY PCD OBJ STL GLB NPZ).")
    ],
    run: RunFolder,
    config: Config,
    where: Where,
    fps: Fps = 30.0,
    model: ModelFile = None,
    pictures: Pictures = True,
) -> None:
    """Segment any sequence of scans into rigid bodies, joints and motion; one scan gets its ellipsoids."""
    from geomocap import pipeline
    from geomocap.cli.jobs import scans_job
    from geomocap.cli.reports import review_job, tell_results

    with scans_job(scans, run, fps, config, where, model) as job:
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
    where: Where,
    preview: Annotated[
        bool, typer.Option("--preview", help="A quick look: some frames a second, small images, the same report.")
    ] = False,
    source: Annotated[Literal["voxels", "cloud"], typer.Option("--source", help="Geometry to work from.")] = "voxels",
    model: ModelFile = None,
    pictures: Pictures = True,
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
    from geomocap.kernels_ahead import kernels_compiled_ahead

    with kernels_compiled_ahead(where.workers), capture_job(capture, run, config, where, model, preview=preview) as job:
        key = pipeline.motion_files(job, source)
        if pictures:
            review_job(job, key)
    if source == "cloud":
        tell_clouds(job.run)
    tell_results(run)
