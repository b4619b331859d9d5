"""The command `geomocap export`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from geomocap.cli.arguments import Wait, Workers
from geomocap.cli.console import console
from geomocap.cli.progress_bars import progress_bars
from geomocap.cli.reports import existing_run, tell_faults, working
from geomocap.cli.settings_options import with_settings
from geomocap.config import Config
from geomocap.export.run_export import Exported, export_run
from geomocap.files.atomic import write_bytes
from geomocap.files.result_schemas import skeleton_gaps
from geomocap.files.results import read_skeleton
from viz.angle_plots import angle_sheet


@with_settings("export")
def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder with skeleton.npz.")],
    config: Config,
    bvh: Annotated[bool, typer.Option("--bvh", help="BVH: y up, metres or centimetres (--bvh-unit).")] = False,
    trc: Annotated[bool, typer.Option("--trc", help="TRC: y up, mm or m (--trc-unit).")] = False,
    c3d: Annotated[bool, typer.Option("--c3d", help="C3D: z up, mm; needs the extra c3d.")] = False,
    glb: Annotated[bool, typer.Option("--glb", help="GLB: y up, m.")] = False,
    usd: Annotated[bool, typer.Option("--usd", help="USD (UsdSkel): y up, m; needs the extra usd.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="CSV: world axes, m and degrees.")] = False,
    parquet: Annotated[bool, typer.Option("--parquet", help="Parquet, as CSV; needs the extra parquet.")] = False,
    angles: Annotated[bool, typer.Option("--angles", help="angles.csv, angles.mot, angles.png: degrees.")] = False,
    osim: Annotated[bool, typer.Option("--osim", help="OpenSim model and motion: y up, m.")] = False,
    urdf: Annotated[bool, typer.Option("--urdf", help="URDF with meshes and joint positions: z up, m.")] = False,
    movement: Annotated[
        bool, typer.Option("--movement", help="netCDF for the package movement; needs the extra movement.")
    ] = False,
    fbx: Annotated[bool, typer.Option("--fbx", help="FBX through Blender, where it is installed.")] = False,
    with_skin: Annotated[bool, typer.Option("--skin", help="The same as --surface skin.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; RUN if not given.")
    ] = None,
    workers: Workers = None,
    wait: Wait = False,
) -> None:
    """Write motion files of a run for Blender, OpenSim, C3D tools, game engines and plots.

    Without a format all are written whose packages are installed, but --osim, --urdf, --movement, --fbx.

    Example: `geomocap export RUN --glb --skin --skin-colors true`
    """
    asked = {"bvh": bvh, "trc": trc, "c3d": c3d, "glb": glb, "usd": usd, "csv": csv, "parquet": parquet}
    asked |= {"angles": angles, "mot": angles, "osim": osim, "urdf": urdf, "movement": movement, "fbx": fbx}
    formats = [name for name, wanted in asked.items() if wanted] or None
    settings = config.export
    if with_skin:
        settings = settings.model_copy(update={"surface": "skin"})
    opened = existing_run(run)
    with working(run, wait) if out is None else nullcontext(), progress_bars() as progress:
        tell_faults(opened)
        exported = export_run(opened, formats, settings, folder=out, progress=progress)
        touched = list(exported.touched)
        if angles and exported.angles is not None and exported.angles.names:
            picture = exported.files["angles"].with_suffix(".png")
            write_bytes(picture, angle_sheet(exported.angles))
            touched.append(picture)
        if out is None:
            opened.renew("export", touched)
    report_exported(exported)
    for gap in skeleton_gaps(read_skeleton(opened)):
        console.print(f"note: {gap}")


def report_exported(exported: Exported) -> None:
    """Print what was written, and how true it is."""
    for path in exported.files.values():
        console.print(f"{path}", markup=False)
    for reason in exported.skipped.values():
        console.print(f"not written: {reason}", markup=False)
    found = exported.found
    if found.template is not None:
        sides = "" if found.sides_known else ", left and right not told: sides are a and b"
        console.print(f"named as {found.template.name}: {len(found.bodies)} bodies, {len(found.joints)} joints{sides}")
    console.print(f"largest deviation from skeleton.npz: {exported.deviation_mm:.3f} mm")
    if exported.moving_joints:
        count = len(exported.moving_joints)
        console.print(f"{count} joints are not fixed in their bodies; they shift in every frame (or --joints fixed)")
