"""Stage: does the result explain what every camera saw? `check.json`."""

from __future__ import annotations

from geomocap.evaluation.result_check import check_run
from geomocap.files.check_file import CHECK, write_self_check
from geomocap.files.run import stage_key
from geomocap.pipeline.job import Job


def check(job: Job, segmented: str) -> str:
    """Compare the posed model and the cameras with the silhouettes; return the stage's key.

    Scans have no silhouettes, and what has no model can't be drawn: then nothing is written.
    """
    key = stage_key(__name__, "check", segmented)
    capture = job.capture
    if capture is None:
        return key

    def work() -> int:
        found = check_run(job.run, capture)
        if found is None:
            return 0
        write_self_check(job.run, found)
        return found.model.size

    return job.stage("check", key, [], work, [CHECK])
