"""Commands that make captures: synthesize, import; convert calibrations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from data_tools.asset import AnimatedAsset
from data_tools.figure import figure, mechanism
from data_tools.gltf_reader import load_gltf
from data_tools.importing import SizeMismatch, import_colmap, import_pose2sim
from data_tools.importing_calibrations import Format, convert_calibration, import_calibration
from data_tools.synthesize import SynthesisSettings
from data_tools.synthesize import synthesize as synthesize_capture
from geomocap.cli.arguments import CaptureFolder, MetresPerUnit, Workers
from geomocap.cli.console import console
from geomocap.cli.execution import executor_for
from geomocap.cli.progress_bars import progress_bars
from geomocap.cli.settings_options import with_file_of_options, with_options_of
from geomocap.settings import LEAST_FPS, MOST_FPS

BUILT_IN: dict[str, Callable[[], AnimatedAsset]] = {"figure": figure, "mechanism": mechanism}


@with_options_of(SynthesisSettings)
def synthesize(
    asset: Annotated[
        str, typer.Argument(metavar="ASSET", help="Animated .glb/.gltf file, or a built-in subject: figure, mechanism.")
    ],
    capture: CaptureFolder,
    settings: SynthesisSettings,
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="DIR", help="Folder for the truth; CAPTURE_truth if not given.")
    ] = None,
    animation: Annotated[
        str | None, typer.Option("--animation", help="Name or number of the animation; the first if not given.")
    ] = None,
    workers: Workers = None,
) -> None:
    """Synthesize a multi-camera capture with ground truth from an animated glTF.

    Example: `geomocap synthesize horse.glb horse --animation Walk --cameras 8 --width 320 --height 240 --fps 15`
    """
    truth = truth or capture.with_name(capture.name + "_truth")
    with executor_for(workers, None) as executor, progress_bars() as progress:
        result = synthesize_capture(
            open_asset(asset, animation), capture, truth, settings, executor=executor, progress=progress
        )
    for note in result.notes:
        console.print(f"note: {note}")
    console.print(f"{capture}: {len(result.rig)} cameras, {settings.frames} frames; truth in {truth}")


@with_file_of_options
def import_(
    kind: Annotated[
        Literal["pose2sim", "colmap", "anipose", "aniposelib", "caliscope", "opencv", "easymocap", "qualisys"],
        typer.Argument(
            metavar="KIND", help="pose2sim, colmap, anipose (or aniposelib), caliscope, opencv, easymocap or qualisys."
        ),
    ],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="The other tool's folder, or its calibration.")],
    capture: CaptureFolder,
    fps: Annotated[
        float, typer.Option("--fps", min=LEAST_FPS, max=MOST_FPS, help="Frames per second, where SOURCE doesn't say.")
    ] = 30.0,
    up: Annotated[
        Literal["y", "z"], typer.Option("--up", help="World axis that points up, where SOURCE doesn't say.")
    ] = "z",
    metres_per_unit: MetresPerUnit = 1.0,
    size_mismatch: Annotated[
        SizeMismatch, typer.Option("--size-mismatch", help="pose2sim: how images came to another size than calibrated.")
    ] = "auto",
    workers: Workers = None,
) -> None:
    """Turn another tool's session into a capture.

    pose2sim: a session folder with calibration/ (Qualisys or Pose2Sim TOML) and videos/.
    colmap: a folder with sparse/ and images/CAMERA/.

    The others are calibrations alone: they are put into CAPTURE, whose images/CAMERA/ or videos/CAMERA.mp4 bear their
    cameras' names.
    """
    if kind not in ("pose2sim", "colmap"):
        rig, notes = import_calibration(source, capture, fps, metres_per_unit=metres_per_unit, up=up)
        for note in notes:
            console.print(f"note: {note}")
        console.print(f"{capture / 'sparse'}: {len(rig)} cameras")
        return
    with progress_bars() as progress:
        if kind == "pose2sim":
            report = import_pose2sim(source, capture, size_mismatch=size_mismatch, progress=progress)
        else:
            report = import_colmap(source, capture, fps, metres_per_unit=metres_per_unit, up=up, progress=progress)
    for note in report.notes:
        console.print(f"note: {note}")
    opened = report.capture
    console.print(f"{capture}: {len(opened.cameras)} cameras, {opened.n_frames} frames at {opened.fps:g} fps")


@with_file_of_options
def convert(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Calibration of any known format.")],
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="File to write; folder for OpenCV, EasyMocap, COLMAP.")
    ],
    kind: Annotated[Format, typer.Option("--format", help="Format to write.")],
    metres_per_unit: MetresPerUnit = 1.0,
    workers: Workers = None,
) -> None:
    """Convert a calibration between the formats of aniposelib, caliscope, Pose2Sim, OpenCV, EasyMocap and COLMAP."""
    rig = convert_calibration(source, target, kind, metres_per_unit=metres_per_unit)
    for note in rig.notes:
        console.print(f"note: {note}")
    console.print(f"{target}: {len(rig)} cameras")


def open_asset(name: str, animation: str | None) -> AnimatedAsset:
    """Make a built-in subject, or load an animated glTF file."""
    if name in BUILT_IN and not Path(name).exists():
        return BUILT_IN[name]()
    chosen = int(animation) if animation is not None and animation.isdigit() else animation
    return load_gltf(Path(name), chosen)
