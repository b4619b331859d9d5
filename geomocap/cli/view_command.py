"""The command `geomocap view`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomocap.cli.arguments import Host, MetresPerUnit, Port, Workers
from geomocap.cli.console import console
from geomocap.cli.foreign_calibrations import foreign_calibration
from geomocap.cli.reports import capture_of, existing_run
from geomocap.cli.settings_options import with_file_of_options
from geomocap.files.run import Run

if TYPE_CHECKING:
    from viz.view_content import Content


@with_file_of_options
def view(
    path: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="Run, capture, scans, calibration, motion file (BVH, TRC, C3D, GLB)."),
    ],
    other: Annotated[
        Path | None, typer.Argument(metavar="OTHER", help="Another one, shown beside it on the same time line.")
    ] = None,
    keypoints: Annotated[
        bool, typer.Option("--keypoints", help="Place and move key-points of a run, as `geomocap keypoints --edit`.")
    ] = False,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    rerun: Annotated[
        Path | None,
        typer.Option("--rerun", metavar="FILE.rrd", help="Write a Rerun recording instead; needs the extra rerun."),
    ] = None,
    metres_per_unit: MetresPerUnit = 1.0,
    workers: Workers = None,
) -> None:
    """Look at a run, capture, scans, calibration or motion file in the browser; needs the extra view.

    Bodies, joints and markers that are clicked tell their name, angle and confidence. New names of a run's bodies and
    joints are written to RUN/names.toml.
    """
    if keypoints:
        from geomocap.cli.keypoint_command import edit_keypoints

        edit_keypoints(existing_run(path), path / "keypoints.toml", host, port, wait=False)
        return
    from viz.viewer import Viewer

    contents = [_content(p, metres_per_unit) for p in (path, other) if p is not None]
    if rerun is not None:
        from viz.rerun_recording import write_recording

        write_recording(rerun, contents)
        console.print(f"recording: {rerun}", markup=False)
        return
    viewer = Viewer(contents, host, port)
    console.print(f"viewer: {viewer.url} (stop with Ctrl+C)", markup=False)
    try:
        viewer.serve()
    except KeyboardInterrupt:
        console.print("stopped")


def _content(path: Path, metres_per_unit: float = 1.0) -> Content:
    """Open whatever is at a path, of this program or another."""
    from viz.view_animation import of_animation
    from viz.view_content import of_rig, open_content

    if path.is_file() and path.suffix.lower() in (".glb", ".gltf"):
        from data_tools.gltf_reader import load_gltf

        return of_animation(path.name, load_gltf(path))
    if path.name in ("run.toml", "capture.toml"):
        path = path.parent
    rig = foreign_calibration(path, metres_per_unit)
    if rig is not None:
        return of_rig(path, rig)
    return open_content(path, capture_of(Run(path)) if (path / "run.toml").is_file() else None)
