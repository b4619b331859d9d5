"""All motion files of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from geomocap.angles.anatomical_frames import anatomical_frames
from geomocap.angles.angle_set import AngleSet
from geomocap.export.angle_files import angle_table, run_angles, write_mot
from geomocap.export.bvh import write_bvh
from geomocap.export.c3d import write_c3d
from geomocap.export.conventions import Axis, Convention
from geomocap.export.export_errors import MissingPackageError, MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.fbx import write_fbx
from geomocap.export.glb import write_glb
from geomocap.export.linked_bodies import LinkedBodies, linked_bodies
from geomocap.export.markers import Markers, markers_from_run
from geomocap.export.model_skin import skin_from_model
from geomocap.export.motion_tree import MotionTree
from geomocap.export.movement_dataset import write_movement
from geomocap.export.names import Names
from geomocap.export.osim import OSIM, write_osim
from geomocap.export.osim_markers import write_osim_markers
from geomocap.export.rest_pose import at_rest
from geomocap.export.run_names import NAMES_FOUND, names_text, run_names
from geomocap.export.skeleton_motion import UNKNOWN_RADIUS, motion_from_skeleton
from geomocap.export.skin import skin_from_run
from geomocap.export.skinned_mesh import SkinnedMesh
from geomocap.export.tables import motion_table, write_csv, write_parquet
from geomocap.export.trc import write_trc
from geomocap.export.urdf import URDF, write_urdf
from geomocap.export.usd import write_usd
from geomocap.files.atomic import remove_remains, write_text
from geomocap.files.results import ELLIPSOIDS, KEYPOINTS, read_ellipsoids, read_keypoint_paths, read_skeleton
from geomocap.files.run import Run
from geomocap.files.run_records import RECORD
from geomocap.model.skeleton import Skeleton
from geomocap.naming.found_names import FoundNames
from geomocap.progress import Progress, silent
from geomocap.settings import check_settings
from geomocap.subject.subject_model import MODEL_FILE, read_model

FILES = {
    "bvh": "motion.bvh",
    "trc": "motion.trc",
    "c3d": "motion.c3d",
    "glb": "motion.glb",
    "usd": "motion.usdc",
    "csv": "motion.csv",
    "parquet": "motion.parquet",
    "angles": "angles.csv",
    "mot": "angles.mot",
    "osim": "motion.osim",
    "urdf": "motion.urdf",
    "movement": "motion.nc",
    "fbx": "motion.fbx",
}
ON_REQUEST = ("osim", "urdf", "movement", "fbx")  # formats that are not written unless asked for


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes
    ----------
    files : dict of format to path
    names_file : Path
        Where names from a template are listed; removed if there are none.
    skipped : dict of format to reason
        Formats that were not asked for by name and could not be written.
    deviation_mm : float
        Largest distance of the files' joints from those of `skeleton.npz`.
    moving_joints : tuple of str
        Nodes that shift against their parents, because their joints are not fixed in the bodies.
    found : FoundNames
        Names from a template.
    angles : AngleSet or None
        Of all joints.
    """

    files: dict[str, Path]
    names_file: Path
    skipped: dict[str, str] = field(default_factory=dict)
    deviation_mm: float = 0.0
    moving_joints: tuple[str, ...] = ()
    found: FoundNames = field(default_factory=FoundNames)
    angles: AngleSet | None = None

    @property
    def touched(self) -> tuple[Path, ...]:
        """Files that were written, and the one that may have been removed, as the run's record wants to know."""
        return (*self.files.values(), self.names_file)


def export_run(
    run: Run | str | Path,
    formats: Sequence[str] | None = None,
    settings: ExportSettings | None = None,
    *,
    names: Names | None = None,
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Exported:
    """Write the motion files of a run, each whole or not at all.

    Parameters
    ----------
    run : Run, str or Path
        The run or its folder, with `skeleton.npz`.
    formats : sequence of str, optional
        Of those in `FILES`. By default all whose packages are installed but those `ON_REQUEST`.
    settings : ExportSettings, optional
        By default those of the run.
    names : Names, optional
        The user's names; by default those that `settings.names` asks for.
    folder : str or Path, optional
        Where to write; by default the run.
    progress : Progress

    Raises
    ------
    MotionError
        If a format that was asked for can't be written, or the skeleton can't be used.
    RunError
        If there is no skeleton.
    SettingsError
        If the run's settings are wrong.
    """
    run = run if isinstance(run, Run) else Run(Path(run))
    into = run.path if folder is None else Path(folder)
    settings = settings or run_settings(run)
    unknown = sorted(set(formats or ()) - set(FILES))
    if unknown:
        raise MotionError(f"{unknown[0]}: no motion format; expected one of {', '.join(FILES)}")
    skeleton = read_skeleton(run)
    up = run_up(run)
    names, found = (names, FoundNames()) if names is not None else run_names(run, skeleton, up, settings)
    radius, root = mean_radius(run), found.trunk
    motion = motion_from_skeleton(skeleton, up=up, names=names, joints=settings.joints, radius=radius, root=root)
    markers = run_markers(run, skeleton, names, up, ellipsoids=settings.ellipsoids)
    mesh = surface_of_run(run, motion, settings)
    shown, skinned = at_rest(motion, mesh, found, settings.rest_pose, anatomical_frames(skeleton, found))

    def links(convention: Convention) -> LinkedBodies:
        fixed = motion_from_skeleton(skeleton, up=up, names=names, joints="fixed", radius=radius, root=root)
        bodies = (names or Names()).body_names(skeleton.body_count, skeleton.body_names)
        labels = (names or Names()).joint_names(skeleton.joint_bodies, bodies, skeleton.joint_names)
        return linked_bodies(fixed, mesh, labels, convention, density=settings.density, radius=radius)

    angles = run_angles(run, skeleton, names, found, settings)
    writers = _writers(motion, markers, shown, skinned, settings) | {
        "angles": lambda path: write_csv(path, angle_table(angles)),
        "mot": lambda path: write_mot(path, angles),
        "osim": lambda path: _write_osim(path, links(OSIM), found, markers.names[: skeleton.joint_count]),
        "urdf": lambda path: write_urdf(path, links(URDF)),
        "fbx": lambda path: _write_fbx(path, shown, skinned),
        "movement": lambda path: write_movement(path, markers),
    }
    remove_remains([into])
    files, skipped = {}, {}
    chosen = list(formats) if formats is not None else [name for name in FILES if name not in ON_REQUEST]
    for k, name in enumerate(chosen):
        path = into / FILES[name]
        try:
            writers[name](path)
            files[name] = path
        except MissingPackageError as error:
            if formats is not None:
                raise
            skipped[name] = str(error)
        progress("export", k + 1, len(chosen))
    listed = into / NAMES_FOUND
    if found.template is not None:
        write_text(listed, names_text(found))
    else:
        listed.unlink(missing_ok=True)
    shifting = tuple(n for n, m, j in zip(motion.names, motion.moving, motion.joints, strict=True) if m and j >= 0)
    deviation = motion.largest_deviation_mm(skeleton.joint_positions)
    return Exported(files, listed, skipped, deviation, shifting, found, angles)


def run_settings(run: Run) -> ExportSettings:
    """Return the settings that a run's motion files were made with, as its record says; the defaults if it doesn't."""
    file = run.path / RECORD
    recorded = run.read_record().get("config", {}).get("export", {}) if file.is_file() else {}
    return check_settings(ExportSettings, recorded, str(file))


def run_up(run: Run) -> Axis:
    """Return the world axis of a run that points up, as its record says; z if there is no record."""
    if not (run.path / RECORD).is_file():
        return "z"
    axes: dict[str, Axis] = {"x": "x", "y": "y", "z": "z"}
    return axes[run.read_record().get("source", {}).get("up", "z")]


def mean_radius(run: Run) -> float:
    """Return the mean semi-axis of a run's ellipsoids, metres."""
    return float(np.mean(read_ellipsoids(run).radii)) if run.has(ELLIPSOIDS) else UNKNOWN_RADIUS


def run_markers(run: Run, skeleton: Skeleton, names: Names | None, up: Axis, *, ellipsoids: bool = True) -> Markers:
    """Return a run's joints, key-points and ellipsoid centres as markers; the bodies' centres if it has none."""
    keypoints = read_keypoint_paths(run) if run.has(KEYPOINTS) else None
    shells = read_ellipsoids(run) if ellipsoids and run.has(ELLIPSOIDS) else None
    return markers_from_run(skeleton, ellipsoids=shells, keypoints=keypoints, names=names, up=up)


def surface_of_run(run: Run, motion: MotionTree, settings: ExportSettings) -> SkinnedMesh | None:
    """Return the surface that GLB and USD show: the model's if there is one, else that of a frame; None: bones."""
    if settings.surface == "bones":
        return None
    if (run.path / MODEL_FILE).is_file() and settings.skin_frame == 0:
        return skin_from_model(read_model(run.path / MODEL_FILE), motion, settings)
    return skin_from_run(run, motion, settings) if settings.surface == "skin" else None


def _write_osim(path: Path, bodies: LinkedBodies, found: FoundNames, labels: tuple[str, ...]) -> None:
    write_osim(path, bodies)
    write_osim_markers(path.with_name(f"{path.stem}_markers.xml"), found, labels)


def _write_fbx(path: Path, motion: MotionTree, mesh: SkinnedMesh | None) -> None:
    with TemporaryDirectory() as folder:
        glb = Path(folder) / FILES["glb"]
        write_glb(glb, motion, mesh)
        write_fbx(path, glb, motion.fps)


def _writers(
    motion: MotionTree, markers: Markers, shown: MotionTree, mesh: SkinnedMesh | None, settings: ExportSettings
) -> dict[str, Callable[[Path], None]]:
    return {
        "bvh": lambda path: write_bvh(path, shown, unit=settings.bvh_unit),
        "trc": lambda path: write_trc(path, markers, unit=settings.trc_unit),
        "c3d": lambda path: write_c3d(path, markers, motion),
        "glb": lambda path: write_glb(path, shown, mesh),
        "usd": lambda path: write_usd(path, shown, mesh),
        "csv": lambda path: write_csv(path, motion_table(markers, motion)),
        "parquet": lambda path: write_parquet(path, motion_table(markers, motion)),
    }
