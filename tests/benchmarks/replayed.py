"""Motion files loaded and replayed by the programs they are for: `python -m tests.benchmarks.replayed RUN ...`.

Each row says how far joints and bodies are from `skeleton.npz` in the worst frame. Programs that are not there are left
out, with a reason. Blender: the package bpy, Blender itself, or the Python in GEOMOCAP_BLENDER_PYTHON that has bpy.
Khronos' validator: the npm package gltf-validator, in NODE_PATH.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.run_export import export_run, run_settings, run_up
from geomocap.export.run_names import run_names
from geomocap.export.urdf import safe_name
from geomocap.files.results import read_skeleton
from geomocap.files.run import Run
from geomocap.model.skeleton import Skeleton

ROOT = Path(__file__).parents[2]
Y_UP = {"z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "y": np.eye(3)}


class NotInstalledError(Exception):
    """A program that isn't there, and what it is called."""


@dataclass(frozen=True)
class Motion:
    """A run, its files, and what its bodies and joints are called in them."""

    folder: Path
    skeleton: Skeleton
    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    y_up: np.ndarray

    @property
    def moved(self) -> list[tuple[int, int]]:
        """The body at whose origin each joint lies in files that grow from another root: child, or else parent."""
        lines = (self.folder / "motion.bvh").read_text().splitlines()
        root = self.bodies.index(next(line.split()[1] for line in lines if line.startswith("ROOT")))
        tree, numbers = self.skeleton.hierarchy.grown_from(root)
        return [(int(j), int(child)) for j, (_, child) in zip(numbers, tree.joint_bodies, strict=True)]


def opensim(motion: Motion) -> tuple[float, float]:
    """Replay motion.osim by motion.mot."""
    osim = _package("opensim")
    osim.Logger.setLevelString("Error")
    osim.ModelVisualizer.addDirToGeometrySearchPaths(str(motion.folder / "Geometry"))
    model = osim.Model(str(motion.folder / "motion.osim"))
    state = model.initSystem()
    table = osim.TimeSeriesTable(str(motion.folder / "motion.mot"))
    labels, values = list(table.getColumnLabels()), table.getMatrix().to_numpy()
    far = turned = 0.0
    for t, row in enumerate(values):
        for label, value in zip(labels, row, strict=True):
            model.getCoordinateSet().get(label).setValue(state, float(value), False)
        model.realizePosition(state)
        for j, body in motion.moved:
            placed = model.getBodySet().get(safe_name(motion.bodies[body])).getTransformInGround(state)
            p, R = placed.p(), placed.R().asMat33()
            place = np.array([p.get(i) for i in range(3)])
            turn = np.array([[R.get(i, k) for k in range(3)] for i in range(3)])
            far = max(far, float(np.linalg.norm(place - motion.y_up @ motion.skeleton.joint_positions[t, j])))
            true = motion.y_up @ motion.skeleton.body_rotations[t, body] @ motion.y_up.T
            turned = max(turned, _angle(turn, true))
    return far, turned


def opensim_markers(motion: Motion) -> tuple[float, float]:
    """Read motion.trc as OpenSim's inverse kinematics does."""
    osim = _package("opensim")
    table = osim.TimeSeriesTableVec3(str(motion.folder / "motion.trc"))
    scale = 1000.0 if table.getTableMetaDataString("Units") == "mm" else 1.0
    far = 0.0
    for j, name in enumerate(motion.joints):
        column = table.getDependentColumn(name)
        found = np.array([[column[t][i] for i in range(3)] for t in range(table.getNumRows())]) / scale
        true = motion.skeleton.joint_positions[:, j] @ motion.y_up.T
        far = max(far, float(np.linalg.norm(found - true, axis=1).max()))
    return far, np.nan


def yourdfpy(motion: Motion) -> tuple[float, float]:
    """Replay motion.urdf by motion_joints.csv."""
    robot = _package("yourdfpy").URDF.load(str(motion.folder / "motion.urdf"), mesh_dir=str(motion.folder))
    far = turned = 0.0
    with (motion.folder / "motion_joints.csv").open() as file:
        for t, row in enumerate(csv.DictReader(file)):
            robot.update_cfg({name: float(row[name]) for name in robot.actuated_joint_names})
            base = np.eye(4)
            base[:3, :3] = Rotation.from_quat([float(row[f"base_q{a}"]) for a in "xyzw"]).as_matrix()
            base[:3, 3] = [float(row[f"base_{a}_m"]) for a in "xyz"]
            for j, body in motion.moved:
                placed = base @ robot.get_transform(safe_name(motion.bodies[body]))
                far = max(far, float(np.linalg.norm(placed[:3, 3] - motion.skeleton.joint_positions[t, j])))
                turned = max(turned, _angle(placed[:3, :3], motion.skeleton.body_rotations[t, body]))
    return far, turned


def ezc3d(motion: Motion) -> tuple[float, float]:
    """Read motion.c3d."""
    file = _package("ezc3d").c3d(str(motion.folder / "motion.c3d"))
    labels, points = file["parameters"]["POINT"]["LABELS"]["value"], file["data"]["points"]
    found = np.stack([points[:3, labels.index(name)].T for name in motion.joints], axis=1) / 1000
    return float(np.linalg.norm(found - motion.skeleton.joint_positions, axis=-1).max()), np.nan


def movement(motion: Motion) -> tuple[float, float]:
    """Read motion.nc; its velocities by movement's own function are those of the joints."""
    _package("movement")
    import xarray
    from movement.kinematics import compute_velocity

    with xarray.open_dataset(motion.folder / "motion.nc", engine="scipy") as data:
        order = ("time", "keypoints", "space")
        mine = data.position.isel(individuals=0).sel(keypoints=list(motion.joints))
        speed = compute_velocity(mine).transpose(*order).values
        found = mine.transpose(*order).values
    true = motion.skeleton.joint_positions
    expected = np.gradient(true, 1 / motion.skeleton.fps, axis=0)
    off = np.abs(speed - expected).max() / motion.skeleton.fps  # metres a frame
    return max(float(np.linalg.norm(found - true, axis=-1).max()), float(off)), np.nan


BLENDER = """
import json, sys
import bpy
sys.path.insert(0, sys.argv[-4])
import blender_geomocap as addon
bpy.ops.wm.read_factory_settings(use_empty=True)
scene, file, fps = bpy.context.scene, sys.argv[-3], float(sys.argv[-2])
scene.render.fps = round(fps)
scene.render.fps_base = scene.render.fps / fps
if file.endswith(".fbx"):
    bpy.ops.import_scene.fbx(filepath=file)
elif file.endswith(".bvh"):
    bpy.ops.import_anim.bvh(filepath=file, rotate_mode="QUATERNION", frame_start=0)
else:
    addon.import_run(__import__("pathlib").Path(file), cameras=False, trails=False)
armature = next(o for o in bpy.data.objects if o.type == "ARMATURE")
first, last = (round(f) for f in armature.animation_data.action.frame_range)
bones = {b.name: [] for b in armature.pose.bones}
for frame in range(first, last + 1):
    scene.frame_set(frame)
    for b in armature.pose.bones:
        bones[b.name].append(list(armature.matrix_world @ b.head))
open(sys.argv[-1], "w").write(json.dumps(bones))
"""


def blender(file: str) -> Callable[[Motion], tuple[float, float]]:
    """Replay a file, or the run's folder by the add-on, in Blender; its axes are z up."""

    def replayed(motion: Motion) -> tuple[float, float]:
        path = motion.folder / file
        if not path.exists():
            raise NotInstalledError(f"no {file}")
        with tempfile.TemporaryDirectory() as folder:
            script, answer = Path(folder) / "replay.py", Path(folder) / "answer.json"
            script.write_text(BLENDER)
            given = [str(ROOT / "tools"), str(path), str(motion.skeleton.fps), str(answer)]
            done = subprocess.run([*_blender(), str(script), *given], capture_output=True, text=True, timeout=600)
            if not answer.is_file():
                raise RuntimeError(done.stdout[-500:] + done.stderr[-500:])
            bones = json.loads(answer.read_text())
        z_up = Y_UP["z"].T @ motion.y_up
        far = 0.0
        for j, body in motion.moved:
            true = motion.skeleton.joint_positions[:, j] @ z_up.T
            found = np.array(bones[motion.bodies[body]])[: len(true)]
            far = max(far, float(np.linalg.norm(found - true[: len(found)], axis=1).max()))
            assert len(found) == len(true), (len(found), len(true))
        return far, np.nan

    return replayed


def khronos(motion: Motion) -> tuple[float, float]:
    """Errors and warnings of Khronos' validator, of motion.glb; both must be 0."""
    node = shutil.which("node")
    if node is None:
        raise NotInstalledError("Node.js")
    code = (
        "const fs=require('fs');require('gltf-validator').validateBytes(new Uint8Array(fs.readFileSync("
        "process.argv[1]))).then(r=>console.log(JSON.stringify(r.issues)))"
    )
    command = [node, "-e", code, str(motion.folder / "motion.glb")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if "Cannot find module" in done.stderr:
        raise NotInstalledError("npm package gltf-validator, in NODE_PATH")
    issues = json.loads(done.stdout)
    return float(issues["numErrors"]), float(issues["numWarnings"])


PROGRAMS: dict[str, Callable[[Motion], tuple[float, float]]] = {
    "opensim: model and motion": opensim,
    "opensim: TRC markers": opensim_markers,
    "yourdfpy": yourdfpy,
    "ezc3d": ezc3d,
    "movement": movement,
    "Blender: add-on, GLB": blender("."),
    "Blender: FBX": blender("motion.fbx"),
    "Blender: BVH": blender("motion.bvh"),
}


def exported(path: Path, folder: Path) -> Motion:
    """Write all files of a run that can be written here."""
    run = Run(path)
    skeleton, up = read_skeleton(run), run_up(run)
    settings = run_settings(run)
    names, _ = run_names(run, skeleton, up, settings)
    formats = ["bvh", "trc", "glb", "osim", "urdf"]
    formats += [f for f, package in (("c3d", "ezc3d"), ("movement", "xarray")) if find_spec(package)]
    chosen = ExportSettings(**settings.model_dump())
    export_run(run, formats, chosen, folder=folder)
    try:
        export_run(run, ["fbx"], chosen, folder=folder)
    except MotionError as error:  # no Blender, or one that reads no GLB
        print(f"FBX is left out: {error}")
    shutil.copy(path / "run.toml", folder)
    bodies = names.body_names(skeleton.body_count, skeleton.body_names)
    return Motion(
        folder, skeleton, bodies, names.joint_names(skeleton.joint_bodies, bodies, skeleton.joint_names), Y_UP[up]
    )


def main(runs: list[str]) -> None:
    """Print a table for each run."""
    for path in map(Path, runs):
        with tempfile.TemporaryDirectory() as folder:
            motion = exported(path, Path(folder))
            print(f"\n{path}: {motion.skeleton.body_count} bodies, {motion.skeleton.frame_count} frames")
            for name, replay in PROGRAMS.items():
                try:
                    far, turned = replay(motion)
                except NotInstalledError as missing:
                    print(f"{name:28s} not here: {missing}")
                    continue
                print(f"{name:28s} {1000 * far:10.5f} mm" + ("" if np.isnan(turned) else f" {turned:10.6f}°"))
            try:
                errors, warnings = khronos(motion)
                print(f"{'Khronos validator':28s} {errors:10.0f} errors, {warnings:.0f} warnings")
            except NotInstalledError as missing:
                print(f"{'Khronos validator':28s} not here: {missing}")


def _package(name: str):
    if find_spec(name) is None:
        raise NotInstalledError(name)
    return __import__(name)


def _blender() -> list[str]:
    if own := os.environ.get("GEOMOCAP_BLENDER_PYTHON"):
        return [own]
    if find_spec("bpy") is not None:
        return [sys.executable]
    if found := shutil.which("blender"):
        return [found, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    raise NotInstalledError("Blender or the package bpy")


def _angle(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.rad2deg(Rotation.from_matrix(found.T @ true).magnitude()))


if __name__ == "__main__":
    main(sys.argv[1:])
