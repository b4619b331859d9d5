"""Where pictures and reports are made from a run, and where a user is told of them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from geomocap.cli.console import console
from geomocap.errors import GeomocapError, RunError
from geomocap.files.atomic import fingerprint
from geomocap.files.camera_file import read_camera_doubts
from geomocap.files.capture import Capture
from geomocap.files.corrected_cameras import as_seen
from geomocap.files.preview import preview_of
from geomocap.files.results import read_cloud_record, read_warnings
from geomocap.files.run import Run, stage_key
from geomocap.files.run_lock import working_in
from geomocap.files.run_records import source_path
from geomocap.files.stage_records import listed_faults
from geomocap.pipeline.camera_stage import agreeing, without_left_out
from geomocap.pipeline.cloud_stage import measure_again
from geomocap.pipeline.job import Job
from geomocap.progress import Progress, silent


def review_job(job: Job, made_from: str) -> None:
    """Make the report of a job, unless it has been made from the same results.

    Parameters
    ----------
    made_from : str
        Key of the last stage that the report shows.
    """
    from viz.review import review  # only where pictures are made: Matplotlib takes half a second

    templates = fingerprint([Path(review.__code__.co_filename).parent / "templates"])
    key = stage_key(review.__module__, "review", made_from, job.up, templates, sorted(job.run.read_timings()))

    def work() -> int:
        written = review_run(job.run, job.capture, job.progress)
        job.run.note("review", written)
        return len(written)

    job.stage("review", key, ["review"], work)


def review_run(run: Run, capture: Capture | None, progress: Progress = silent) -> list[Path]:
    """Make pictures and report of a run, with a frame's surface measured again where it was measured."""
    from viz.review import review

    capture = None if capture is None else as_seen(run, capture)
    preview = run.read_record().get("source", {}).get("preview") is not None
    measured = partial(measure_again, run, capture)
    return review(run, capture, quick=preview, measured=measured, progress=progress)


def agreeing_job(job: Job) -> Job:
    """Check the cameras of a job, print what is doubtful, and return it without those that are to be left out."""
    job, warnings = agreeing(job)
    for warning in warnings:
        console.print(f"warning: {warning}", markup=False)
    return job


@contextmanager
def working(run: Path, wait: bool) -> Iterator[None]:
    """Keep other processes out of a run while this command writes into it."""
    with working_in(Run(run), " ".join(sys.argv[1:2]), wait=wait, tell=tell_note):
        yield


def existing_run(path: Path) -> Run:
    """Return the run of a folder that is there.

    Raises
    ------
    RunError
        If there is none.
    """
    if not path.is_dir():
        raise RunError(f"{path}: no run folder; make one with `geomocap run` or `geomocap segment`")
    return Run(path)


def tell_note(text: str) -> None:
    """Print what the user should know."""
    console.print(f"note: {text}", markup=False)


def tell_faults(run: Run) -> None:
    """Warn of files that are no longer as the run wrote them."""
    faults = run.faults()
    if faults:
        console.print(f"warning: {listed_faults(faults)}; start the run again and it is made again", markup=False)


def capture_of(run: Run) -> Capture | None:
    """Open the capture that a run was made from; None if there was none or it has gone."""
    source = run.read_record().get("source", {})
    if source.get("kind") != "capture" or "path" not in source:
        return None
    try:
        whole = preview_of(Capture.open(source_path(run.path, source)), source.get("preview"))
        opened = without_left_out(whole, read_camera_doubts(run))
        return as_seen(run, opened)
    except GeomocapError as error:
        tell_note(f"the capture can't be shown ({error})")
        return None


def tell_results(run: Path) -> None:
    """Print what is doubtful, and where the results are."""
    for warning in read_warnings(Run(run)):
        console.print(f"warning: {warning}")
    for what, file in (("motion", "motion.bvh"), ("report", "review/report.html")):
        if (run / file).exists():
            console.print(f"{what}: {run / file}", markup=False)


def tell_clouds(run: Run) -> None:
    """Print how many points were measured, why others were not, and what looks wrong with the cameras."""
    record = read_cloud_record(run)
    if record is None:
        return
    console.print(f"cloud: {record.points / record.frames:,.0f} points per frame")
    for reason, number in sorted(record.reasons.items(), key=lambda r: -r[1]):
        console.print(f"  {number / record.frames:>9,.0f} {reason}")
    for warning, frames in record.warnings.items():
        console.print(
            f"warning: {warning}" + (f" (in {frames} of {record.frames} frames)" if record.frames > 1 else "")
        )
