"""From the arguments of a command to a job with its executor and progress bars."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from pathlib import Path

from geomocap.cli.arguments import Where
from geomocap.cli.execution import executor_for
from geomocap.cli.progress_bars import progress_bars
from geomocap.cli.reports import agreeing_job, tell_note, working
from geomocap.config import Config, preview_config
from geomocap.errors import GeomocapError, RunError
from geomocap.files.capture import Capture
from geomocap.files.preview import PreviewCapture
from geomocap.files.run import Run
from geomocap.files.scans import open_scans
from geomocap.pipeline.job import Job
from geomocap.progress import Progress
from geomocap.subject.subject_model import MODEL_FILE, read_model

CAPTURE_FOLDERS = ("images", "videos", "background", "masks", "sparse", "bar")  # of a capture


@contextmanager
def capture_job(
    capture: Path, run: Path, config: Config, where: Where, model: Path | None = None, *, preview: bool = False
) -> Iterator[Job]:
    """Make the job of a capture or of its preview, with the subject's model if there is one."""
    opened = Capture.open(capture)
    if preview:
        opened, config = PreviewCapture.of(opened), preview_config(config)
        tell_note(
            f"preview: {opened.n_frames} frames, {opened.fps:.3g} a second, images of about {opened.longest} pixels"
        )
    _check_apart(capture, run)
    _check_model(model, run)
    with suppress(GeomocapError):  # what is wrong with the cameras, the stages that need them say
        for note in opened.rig.notes:
            tell_note(note)
    with _at_work(run, where) as (executor, progress):
        job = Job(Run(run), config, executor, progress, capture=opened, fps=opened.fps, model=model, tell=tell_note)
        yield agreeing_job(job)


@contextmanager
def scans_job(
    scans: Path, run: Path, fps: float, config: Config, where: Where, model: Path | None = None
) -> Iterator[Job]:
    """Make the job of a sequence of scans, with the subject's model if there is one."""
    opened = open_scans(scans, config.scans)
    _check_apart(scans, run)
    _check_model(model, run)
    with _at_work(run, where) as (executor, progress):
        yield Job(Run(run), config, executor, progress, scans=opened, fps=fps, model=model, tell=tell_note)


@contextmanager
def _at_work(run: Path, where: Where) -> Iterator[tuple[Executor, Progress]]:
    """Keep others out of a run, with an executor and progress bars."""
    with working(run, where.wait), executor_for(where.workers, where.scheduler) as executor, progress_bars() as shown:
        yield executor, shown


def _check_model(model: Path | None, run: Path) -> None:
    """A model is read before long work begins; that of the run itself would be overwritten."""
    if model is None:
        return
    read_model(model)
    if model.resolve() == (run / MODEL_FILE).resolve():
        raise RunError(f"{model}: is the model of this very run; choose another folder for the sequence")


def _check_apart(source: Path, run: Path) -> None:
    """A run must not write into what it reads."""
    source, place = Path(os.path.realpath(source)), Path(os.path.realpath(run))
    if place == source or place in source.parents:
        raise RunError(f"{run}: holds the input {source}; choose another folder for the run")
    for part in CAPTURE_FOLDERS:
        if place.is_relative_to(source / part):
            raise RunError(f"{run}: is inside {source / part}, which is part of the input; choose another folder")
