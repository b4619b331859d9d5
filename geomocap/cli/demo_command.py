"""The demo: a built-in capture, taken all the way to the report.

What does the work is imported after the second process has begun, which imports much of the same.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geomocap.cli.arguments import Where, Workers
from geomocap.cli.settings_options import with_file_of_options
from geomocap.config import Config
from geomocap.kernels_ahead import kernels_compiled_ahead


@with_file_of_options
def demo(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for capture, truth and run.")] = Path("demo"),
    workers: Workers = None,
) -> None:
    """Synthesize a small capture of the built-in figure and take it all the way to the report."""
    with kernels_compiled_ahead(workers):
        _take_to_the_report(out, workers)


def _take_to_the_report(out: Path, workers: int | None) -> None:
    from data_tools.figure import figure
    from data_tools.synthesize import SynthesisSettings, synthesize
    from geomocap import pipeline
    from geomocap.cli.execution import executor_for
    from geomocap.cli.jobs import capture_job
    from geomocap.cli.progress_bars import progress_bars
    from geomocap.cli.reports import review_job, tell_results

    capture, truth, run = out / "capture", out / "truth", out / "run"
    small = SynthesisSettings(cameras=8, width=320, height=240, fps=12, frames=24)
    with executor_for(workers, None) as executor, progress_bars() as progress:
        if not (capture / "capture.toml").exists():
            synthesize(figure(), capture, truth, small, executor=executor, progress=progress)
    with capture_job(capture, run, Config(), Where(workers)) as job:
        key = pipeline.motion_files(job, "voxels")
        review_job(job, key)
    tell_results(run)
