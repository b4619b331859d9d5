"""The command `geomocap keypoints`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from geomocap.cli.arguments import ExistingRun, Host, Port, Wait, Workers
from geomocap.cli.console import console
from geomocap.cli.export_command import report_exported
from geomocap.cli.reports import capture_of, existing_run, tell_faults, working
from geomocap.cli.settings_options import with_file_of_options
from geomocap.errors import GeomocapError
from geomocap.export.run_export import export_run
from geomocap.files.results import SKELETON, read_followed, read_followed_by_frame
from geomocap.files.run import Run
from geomocap.keypoints.keypoint_following import Measured
from geomocap.keypoints.keypoint_regions import KeyPointFile, read_keypoints, write_keypoints
from geomocap.pipeline.keypoint_stage import FollowedKeyPoints, clear_results, run_fps
from geomocap.pipeline.keypoint_stage import keypoints as follow_keypoints


@with_file_of_options
def keypoints(
    run: ExistingRun,
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="FILE.toml", help="Key-points; RUN/keypoints.toml if not given."),
    ] = None,
    edit: Annotated[
        bool, typer.Option("--edit", help="Place, move and name them in the browser; needs the extra editor.")
    ] = False,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    workers: Workers = None,
    wait: Wait = False,
) -> None:
    """Follow key-points on the surface, given as `[[keypoint]]` tables: name, center (m), radius (m), frame.

    Writes keypoints.npz, .trc and .c3d, and the motion files of a run with a skeleton anew with the key-points as
    markers. `links = [["hand", "elbow"]]` joins key-points by lines in the report's plots.

    With `--edit` the key-points are placed on the surface in the browser and saved as such a file.
    """
    file = points or run / "keypoints.toml"
    opened = existing_run(run)
    tell_faults(opened)
    if edit:
        edit_keypoints(opened, file, host, port, wait)
        return
    wanted = read_keypoints(file)
    with working(run, wait):
        _report(opened, wanted, follow_keypoints(opened, wanted))


def edit_keypoints(run: Run, file: Path, host: str, port: int, wait: bool) -> None:
    """Serve the editor until the user interrupts it; save when asked to."""
    from viz.keypoint_editor import KeyPointEditor
    from viz.keypoint_scene import Subject
    from viz.keypoint_session import Follower, Session
    from viz.run_contents import Results

    tracks = read_followed(run)
    begun = read_keypoints(file) if file.exists() else KeyPointFile()
    subject = Subject(Results(run, capture_of(run)), tracks.positions, run_fps(run))

    def save(wanted: KeyPointFile) -> str:
        with working(run.path, wait):  # not all the time that the page is open
            return save_alone(wanted)

    def save_alone(wanted: KeyPointFile) -> str:
        write_keypoints(file, wanted)
        if not wanted.keypoint:
            clear_results(run)
            return f"Saved {file.name}, without key-points."
        try:
            found = follow_keypoints(run, wanted)
        except GeomocapError as error:
            clear_results(run)
            return f"Saved {file.name}, but nothing was followed: {error}"
        _report(run, wanted, found)
        return f"Saved {', '.join(p.name for p in (file, *found.files))}."

    editor = KeyPointEditor(
        subject, Follower(Measured.of(read_followed_by_frame(run))), Session.open(begun), save, host, port
    )
    console.print(f"editor: {editor.url} (stop with Ctrl+C)", markup=False)
    try:
        editor.serve()
    except KeyboardInterrupt:
        if editor.session.is_changed:
            console.print("stopped; the last changes were not saved")


def _report(run: Run, file: KeyPointFile, found: FollowedKeyPoints) -> None:
    """Print how far each key-point was followed and what was written; write the run's motion files anew."""
    present = np.isfinite(found.points.paths.positions[:, :, 0])
    for k, point in enumerate(file.keypoint):
        bridged = int((found.points.paths.bridged[:, k] & present[:, k]).sum())
        console.print(
            f"{point.name}: followed in {present[:, k].sum()} of {len(present)} frames, {bridged} of them bridged",
            markup=False,
        )
    for path in found.files:
        console.print(f"{path}", markup=False)
    for reason in found.skipped:
        console.print(f"not written: {reason}", markup=False)
    if run.has(SKELETON):
        exported = export_run(run)
        run.renew("export", exported.touched)
        report_exported(exported)
