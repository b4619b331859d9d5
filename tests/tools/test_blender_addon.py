"""The Blender add-on: a run imported in background mode stands and moves where the run's files have it."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from geomocap.export.run_export import export_run
from geomocap.files.results import read_skeleton
from tests.arrows import ROOT
from tests.viz.conftest import make

SCRIPT = """
import json, sys
sys.path.insert(0, sys.argv[-4])
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
import blender_geomocap as addon
addon.register()
out = {"result": list(bpy.ops.import_scene.geomocap(directory=sys.argv[-3]))}
scene = bpy.context.scene
armature = next(o for o in bpy.data.objects if o.type == "ARMATURE")
out["frames"] = [scene.frame_start, scene.frame_end, scene.render.fps / scene.render.fps_base]
out["bones"] = {b.name: [] for b in armature.pose.bones}
for frame in range(scene.frame_start, scene.frame_end + 1):
    scene.frame_set(frame)
    for b in armature.pose.bones:
        out["bones"][b.name].append(list(armature.matrix_world @ b.matrix.translation))
out["meshes"] = [o.name for o in bpy.data.objects if o.type == "MESH" and o.find_armature() == armature]
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
points = [Vector(p) for p in json.loads(sys.argv[-2])]
out["cameras"] = {}
for o in bpy.data.objects:
    if o.type == "CAMERA":
        scene.render.resolution_x, scene.render.resolution_y = 160, 120
        image = o.data.background_images[0].image
        views = [list(world_to_camera_view(scene, o, p)) for p in points]
        out["cameras"][o.name] = {"views": views, "image": image.filepath, "source": image.source}
curves = {o.name: o for o in bpy.data.objects if o.type == "CURVE"}
out["trails"] = {n: [list(p.co)[:3] for p in o.data.splines[0].points] for n, o in curves.items()}
addon.unregister()
open(sys.argv[-1], "w").write(json.dumps(out))
"""


def blender() -> list[str]:
    """Return the command that runs a script in Blender's Python."""
    if own := os.environ.get("GEOMOCAP_BLENDER_PYTHON"):  # a Python that has the package bpy
        return [own]
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable]
    if found := shutil.which("blender"):
        return [found, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    pytest.skip("neither Blender nor the package bpy is installed")


def check_answered(answer: Path, done: subprocess.CompletedProcess[str]) -> None:
    """Fail with what Blender said if it gave no answer; skip where its own glTF add-on doesn't suit its NumPy.

    Debian 12's Blender 3.4 asks for `numpy.bool`, which Debian 12's NumPy 1.24 no longer has.
    """
    said = done.stdout[-4000:] + done.stderr[-4000:]
    if not answer.is_file() and "io_scene_gltf2" in said and "module 'numpy' has no attribute 'bool'" in said:
        pytest.skip("this Blender's glTF add-on doesn't suit its NumPy (numpy.bool): it can read no GLB at all")
    assert answer.is_file(), said


def test_a_run_is_imported_as_it_is(tmp_path: Path) -> None:
    command = blender()
    made = make(tmp_path)
    from_run = os.path.relpath(made.capture.path, made.run.path)
    record = {"source": {"kind": "capture", "path": "/before/it/was/moved", "from_run": from_run, "up": "z"}}
    made.run.write_record(record)
    (made.run.path / "names.toml").write_text("[bodies]\nmy_head = 1\n")
    export_run(made.run, ["glb"])
    script, answer = tmp_path / "script.py", tmp_path / "answer.json"
    script.write_text(SCRIPT)
    points = [[0.1, 0.2, 1.0], [-0.2, 0.1, 0.6], [0.0, 0.0, 1.5]]
    more = [str(ROOT / "tools"), str(made.run.path), json.dumps(points), str(answer)]
    between = ["--"] if command[-1] == "--python" else []
    done = subprocess.run([*command, str(script), *between, *more], capture_output=True, text=True, timeout=300)
    check_answered(answer, done)
    found = json.loads(answer.read_text())

    assert found["result"] == ["FINISHED"] and len(found["meshes"]) == 1
    start, end, fps = found["frames"]
    assert end - start + 1 == 6 and fps == pytest.approx(30)
    skeleton = read_skeleton(made.run)
    assert "my_head" in found["bones"]
    joint = skeleton.joint_bodies[:, 1].tolist().index(1)
    np.testing.assert_allclose(found["bones"]["my_head"], skeleton.joint_positions[:, joint], atol=1e-4)
    np.testing.assert_allclose(found["trails"]["my_head trail"], skeleton.joint_positions[:, joint], atol=1e-4)

    assert sorted(found["cameras"]) == sorted(made.rig.names)
    for c, name in enumerate(made.rig.names):
        told, camera = found["cameras"][name], made.rig.cameras[c]
        views = np.array(told["views"])
        seen = np.column_stack([160 * views[:, 0], 120 * (1 - views[:, 1])])
        expected = made.rig.to_camera(np.array(points))[c] @ camera.calibration_matrix().T  # Blender has no distortion
        np.testing.assert_allclose(seen, expected[:, :2] / expected[:, 2:], atol=0.05)
        assert told["source"] == "SEQUENCE" and told["image"].endswith(f"{name}/000000.png")


def test_folders_that_are_no_runs_are_told(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nsys.path.insert(0, sys.argv[-2])\nfrom pathlib import Path\n"
        "import bpy, blender_geomocap as addon\n"
        "try:\n    addon.import_run(Path(sys.argv[-1]))\nexcept addon.RunError as error:\n    print('told:', error)\n"
    )
    command = blender()
    between = ["--"] if command[-1] == "--python" else []
    run = [*command, str(script), *between, str(ROOT / "tools"), str(tmp_path)]
    done = subprocess.run(run, capture_output=True, text=True, timeout=300)
    assert "told:" in done.stdout and "no motion.glb" in done.stdout
