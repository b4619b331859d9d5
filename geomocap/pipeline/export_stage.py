"""Stage: skeleton → motion files, all whose packages are installed."""

from __future__ import annotations

from pathlib import Path

from geomocap.export.run_export import FILES, export_run
from geomocap.export.run_names import NAMES_FOUND
from geomocap.files.atomic import fingerprint
from geomocap.files.results import ELLIPSOIDS, SKELETON
from geomocap.files.run import stage_key
from geomocap.pipeline.check_stage import check
from geomocap.pipeline.job import Job
from geomocap.pipeline.segmentation_stage import segment
from geomocap.pipeline.sources import Source


def motion_files(job: Job, source: Source) -> str:
    """Take a capture or scans all the way to the motion files, as the record says then; return the stage's key."""
    job.write_record()
    segmented = segment(job, source)
    if not job.run.has(SKELETON):
        job.tell(
            f"{job.source}: a single frame shows no motion; joints and motion files take more frames, {ELLIPSOIDS} "
            "and bodies/ were made"
        )
        return segmented
    check(job, segmented)
    named = Path(job.config.export.names)
    files = [job.run.path / name for name in ("names.toml", "keypoints.npz")] + [named] * named.is_file()
    beside = fingerprint(files)
    key = stage_key(__name__, "export", segmented, job.config.export.model_dump(), job.up, beside)

    def work() -> int:
        written = export_run(job.run, settings=job.config.export, progress=job.progress)
        return len(written.files)

    always = [FILES["bvh"], FILES["trc"], FILES["glb"]]
    return job.stage("export", key, always, work, [*(f for f in FILES.values() if f not in always), NAMES_FOUND])
