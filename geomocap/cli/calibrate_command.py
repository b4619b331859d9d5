"""The command that calibrates a capture with a reference bar."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from data_tools.calibration_files import read_calibration
from geomocap.calibration.bar_calibration import Calibration, calibrate_bar, check_replaceable
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.from_capture import calibrate_capture, up_of, with_l_shape, with_points
from geomocap.calibration.observed_points import observations_of, read_observed
from geomocap.calibration.recording import Recording, check_length
from geomocap.calibration.world import WorldKnowledge
from geomocap.cli.arguments import CaptureFolder, Workers
from geomocap.cli.console import console
from geomocap.cli.execution import executor_for
from geomocap.cli.progress_bars import progress_bars
from geomocap.cli.settings_options import with_options_of
from geomocap.errors import CalibrationError, CaptureError, GeomocapError
from geomocap.files.capture import Capture, read_capture_info
from viz.calibration_report import write_calibration_report

LAST_FRAME = 999_999  # names of frames have six digits


@with_options_of(BarSettings)
def calibrate(
    capture: CaptureFolder,
    settings: BarSettings,
    distance: Annotated[
        float | None,
        typer.Option("--distance", help="Length of the bar between the target centres (m); else bar.toml's."),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="CSV", help="Observed points (frame,camera,point,x,y) instead of images."),
    ] = None,
    ends: Annotated[
        list[str] | None,
        typer.Option("--ends", metavar="A,B", help="With --points: the two points that are the bar; may be repeated."),
    ] = None,
    floor: Annotated[
        str | None,
        typer.Option("--floor", metavar="FRAMES", help="Frames in which the bar lies on the floor: 0-3,17."),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option("--reference", metavar="DIR", help="Images of an L-shaped reference, with reference.toml."),
    ] = None,
    world_points: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            "--world-points", metavar="SEEN.csv WORLD.csv", help="Observed points, and their x,y,z by name (m)."
        ),
    ] = None,
    gravity: Annotated[
        str | None,
        typer.Option("--gravity", metavar="CAMERA:X,Y,Z", help="Downwards in a camera's axes; level: cam0:0,1,0."),
    ] = None,
    align: Annotated[
        Path | None, typer.Option("--align", metavar="PATH", help="Existing calibration whose world is kept.")
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option("--intrinsics", metavar="PATH", help="Calibration whose interior orientations are kept."),
    ] = None,
    report: Annotated[bool, typer.Option(help="Write CAPTURE/calibration/report.html with pictures.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace a calibration made by something else.")] = False,
    workers: Workers = None,
) -> None:
    """Calibrate the cameras of a capture with a reference bar; writes CAPTURE/sparse and a report.

    A bar with two bright balls a known distance apart is moved through the whole volume, turned in all directions, and
    recorded by all cameras: `CAPTURE/bar/<camera>/000000.png` or `CAPTURE/bar/<camera>.mp4`, and CAPTURE/bar/bar.toml
    with `length = 0.5` (m). Nothing else need be known.

    Example: `geomocap calibrate studio --distance 0.5 --floor 0-5`
    """
    if distance is not None:
        check_length(distance)
    if ends and points is None:
        raise CalibrationError("--ends names points of a table; give it by --points")
    check_replaceable(capture / "sparse", force)
    world = WorldKnowledge(
        rig=None if align is None else read_calibration(align),
        floor=_frames(floor) if floor else (),
        gravity=_gravity(gravity) if gravity else None,
        up=up_of(capture),
    )
    given = None if intrinsics is None else read_calibration(intrinsics)
    with executor_for(workers, None) as executor, progress_bars() as progress:
        if points is not None:
            if distance is None:
                raise CalibrationError("--points needs --distance, the known distance of the two points in metres")
            observed = read_observed(points)
            pairs = [_pair(e) for e in ends] if ends else None
            observations = observations_of(observed, pairs, _sizes(capture))
            world = _with_reference(world, reference, world_points, observations.cameras, settings)
            result = calibrate_bar(observations, distance, settings, world, given, progress=progress)
        else:
            names = _bar_cameras(capture)
            world = _with_reference(world, reference, world_points, names, settings)
            result = calibrate_capture(capture, settings, world, given, distance, progress, executor)
    result.write(capture / "sparse", force=force)
    _tell(result, capture)
    if report:
        console.print(f"report: {write_calibration_report(result, capture / 'calibration')}")


def _tell(result: Calibration, capture: Path) -> None:
    console.print(result.verdict.summary)
    console.print(
        f"sigma0 {result.sigma0:.2f}, bar ends to {1000 * result.covariance.point_sigma:.3f} mm, "
        f"world from {result.datum.source}"
    )
    for warning in result.verdict.warnings:
        console.print(f"warning: {warning}")
    console.print(f"calibration: {capture / 'sparse'}")


def _bar_cameras(capture: Path) -> tuple[str, ...]:

    cameras = read_capture_info(capture).cameras if (capture / "capture.toml").exists() else None
    return Recording.open(capture / "bar", cameras, 1.0).cameras


def _with_reference(
    world: WorldKnowledge,
    reference: Path | None,
    world_points: tuple[Path, Path] | None,
    cameras: tuple[str, ...],
    settings: BarSettings,
) -> WorldKnowledge:
    if world_points is not None:
        return with_points(world, read_observed(world_points[0]), _coordinates(world_points[1]), cameras)
    if reference is not None:
        return with_l_shape(world, reference, cameras, settings)
    return world


def _sizes(capture: Path) -> dict[str, tuple[int, int]] | None:
    """Image sizes of a capture's own images; None if it has none."""
    try:
        opened = Capture.open(capture)
    except CaptureError:
        return None
    return {n: (f.shape[1], f.shape[0]) for n in opened.cameras for f in [opened.frame(n, 0)]}


def _frames(text: str) -> tuple[int, ...]:
    out: list[int] = []
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if not first.isdecimal() or (last and not last.isdecimal()):
            raise GeomocapError(f"--floor {text}: expected frame numbers such as 0-3,17")
        if int(first) > int(last or first) or int(last or first) > LAST_FRAME:
            raise GeomocapError(f"--floor {text}: {part.strip()} are no frames; expected numbers such as 0-3,17")
        out.extend(range(int(first), int(last or first) + 1))
    return tuple(out)


def _pair(text: str) -> tuple[str, str]:
    names = [p.strip() for p in text.split(",")]
    if len(names) != 2 or not all(names):
        raise GeomocapError(f"--ends {text}: expected two point names such as 0,11")
    return names[0], names[1]


def _gravity(text: str) -> tuple[str, tuple[float, float, float]]:
    camera, _, numbers = text.rpartition(":")
    try:
        x, y, z = (float(v) for v in numbers.split(","))
    except ValueError:
        raise GeomocapError(f"--gravity {text}: expected CAMERA:X,Y,Z such as cam0:0,1,0") from None
    return camera, (x, y, z)


def _coordinates(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
        return {r["point"].strip(): np.array([float(r[k]) for k in "xyz"]) for r in rows}
    except (OSError, UnicodeDecodeError, csv.Error, KeyError, TypeError, ValueError, AttributeError):
        raise CalibrationError(f"{path}: no readable table with the columns point,x,y,z (metres)") from None
