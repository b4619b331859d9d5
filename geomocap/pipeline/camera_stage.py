"""Stage: do the cameras fit together? `cameras.json`; those that don't may be left out."""

from __future__ import annotations

from dataclasses import replace

from geomocap.errors import CaptureError
from geomocap.evaluation.camera_check import check_cameras_of
from geomocap.files.camera_file import CAMERAS, CameraDoubts, read_camera_doubts, write_camera_doubts
from geomocap.files.capture import Capture
from geomocap.files.run import stage_key
from geomocap.pipeline.job import Job

FEWEST = 2  # cameras, without which there is no depth


def agreeing(job: Job) -> tuple[Job, tuple[str, ...]]:
    """Check the cameras of a job; return it without those to be left out, and what is to be told to the user.

    Raises
    ------
    CaptureError
        If cameras contradict the others and the settings say to stop, or too few are left without them.
    """
    capture = job.capture
    if capture is None:
        return job, ()
    wish = job.config.cameras.that_disagree
    parts = capture.fingerprint("images", "videos", "background", "masks", "sparse")
    settings = job.config.silhouettes
    key = stage_key(__name__, "cameras", str(capture.path.resolve()), parts, settings.model_dump(), wish)

    def work() -> int:
        found = check_cameras_of(capture, settings, job.executor, job.progress)
        left_out = found.contradicting if wish == "drop" else ()
        write_camera_doubts(job.run, CameraDoubts(found.contradicting, left_out, found.warnings))
        return len(capture.cameras)

    job.write_record("cameras")
    job.stage("cameras", key, [CAMERAS], work)
    doubts = read_camera_doubts(job.run)
    if doubts.contradicting and wish == "stop":
        raise CaptureError(
            f"{capture.path}: {'; '.join(doubts.warnings)}; mend that, or set --cameras-that-disagree to warn or drop"
        )
    if not doubts.left_out:
        return job, tuple(doubts.warnings)
    if len(capture.cameras) - len(doubts.left_out) < FEWEST:
        raise CaptureError(
            f"{capture.path}: too few cameras are left without {', '.join(doubts.left_out)} "
            f"({'; '.join(doubts.warnings)})"
        )
    told = f"left out: {', '.join(doubts.left_out)}"
    return replace(job, capture=without_left_out(capture, doubts)), (*doubts.warnings, told)


def without_left_out(capture: Capture, doubts: CameraDoubts) -> Capture:
    """Return a capture as a run uses it, without the cameras that it leaves out."""
    return capture.without(doubts.left_out) if doubts.left_out else capture
