"""The command `geomocap keypoints`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from geomocap.cli.export import report_exported
from geomocap.cli.reports import console
from geomocap.export.run_export import export_run
from geomocap.pipeline.keypoints import FollowedKeyPoints
from geomocap.pipeline.keypoints import keypoints as follow_keypoints
from geomocap.run import Run
from geomocap.tracking.keypoint_file import KeyPointFile, read_keypoints


def keypoints(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder with tracks.npz.")],
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="FILE.toml", help="Key-points; RUN/keypoints.toml if not given."),
    ] = None,
) -> None:
    """Follow key-points on the surface, given as `[[keypoint]]` tables: name, center (m), radius (m), frame.

    Writes keypoints.npz, .trc and .c3d, and the motion files of a run with a skeleton anew with the key-points as
    markers. `links = [["hand", "elbow"]]` joins key-points by lines in the report's plots.
    """
    file = read_keypoints(points or run / "keypoints.toml")
    report_keypoints(Run(run), file, follow_keypoints(Run(run), file))


def report_keypoints(run: Run, file: KeyPointFile, found: FollowedKeyPoints) -> None:
    """Print how far each key-point was followed and what was written; write the run's motion files anew."""
    present = np.isfinite(found.paths.positions[:, :, 0])
    for k, point in enumerate(file.keypoint):
        bridged = int((found.paths.bridged[:, k] & present[:, k]).sum())
        console.print(
            f"{point.name}: followed in {present[:, k].sum()} of {len(present)} frames, {bridged} of them bridged",
            markup=False,
        )
    for path in found.files:
        console.print(f"{path}", markup=False)
    for reason in found.skipped:
        console.print(f"not written: {reason}", markup=False)
    if (run.path / "skeleton.npz").exists():
        report_exported(export_run(run))
