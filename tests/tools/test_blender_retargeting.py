"""Retargeting by Blender's own constraints: another armature with Mixamo's names moves as the subject does."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np

from geomocap.export.export_settings import ExportSettings
from geomocap.export.run_export import export_run
from geomocap.files.run import Run
from geomocap.naming.name_templates import read_template
from tests.geomocap.template_figures import figure
from tests.tools.test_blender_addon import blender, check_answered

# A person in a T pose as animators build them, facing -y: other proportions, bones in between, any roll about bones.
SCRIPT = """
import json, sys
import bpy
from mathutils import Vector

bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = 30  # as the motion
bpy.ops.import_scene.gltf(filepath=sys.argv[-2])
subject = next(o for o in bpy.data.objects if o.type == "ARMATURE")

SPINE = [("Hips", None, (0, 0, 1.0)), ("Spine", "Hips", (0, 0, 1.12)), ("Spine1", "Spine", (0, 0.01, 1.24)),
         ("Spine2", "Spine1", (0, 0.01, 1.36)), ("Neck", "Spine2", (0, 0.02, 1.52)), ("Head", "Neck", (0, 0.01, 1.62))]
LIMBS = [("Shoulder", "Spine2", (0.04, 0.02, 1.47)), ("Arm", "Shoulder", (0.19, 0.02, 1.47)),
         ("ForeArm", "Arm", (0.49, 0.02, 1.47)), ("Hand", "ForeArm", (0.74, 0.02, 1.47)),
         ("UpLeg", "Hips", (0.11, 0, 0.95)), ("Leg", "UpLeg", (0.11, 0, 0.52)), ("Foot", "Leg", (0.11, 0, 0.09))]
LENGTH = {"Head": (0, 0, 0.2), "Hand": (0.12, 0, 0), "Foot": (0, -0.12, -0.06)}
bones = list(SPINE)
for side, sign in (("Left", 1), ("Right", -1)):
    for name, parent, (x, y, z) in LIMBS:
        bones.append((side + name, parent if parent in ("Spine2", "Hips") else side + parent, (sign * x, y, z)))
data = bpy.data.armatures.new("other")
other = bpy.data.objects.new("other", data)
scene.collection.objects.link(other)
bpy.context.view_layer.objects.active = other
bpy.ops.object.mode_set(mode="EDIT")
heads = {name: Vector(place) for name, _, place in bones}
for number, (name, parent, place) in enumerate(bones):
    bone = data.edit_bones.new("mixamorig:" + name)
    bone.head = place
    child = next((c for c, p, _ in bones if p == name and name not in ("Hips", "Spine2")), None)
    plain = name.replace("Left", "").replace("Right", "")
    end = Vector(LENGTH.get(plain, (0, 0, 0.1)))
    end.x *= -1 if name.startswith("Right") else 1
    bone.tail = heads[child] if child else bone.head + end
    bone.roll = 0.37 * number  # whatever the animator's tool has made of it
    if parent:
        bone.parent = data.edit_bones["mixamorig:" + parent]
bpy.ops.object.mode_set(mode="POSE")

shared = [b.name for b in other.pose.bones if b.name in subject.pose.bones]
for name in shared:
    copy = other.pose.bones[name].constraints.new("COPY_ROTATION")
    copy.target, copy.subtarget = subject, name
    copy.target_space, copy.owner_space = "LOCAL_OWNER_ORIENT", "LOCAL"

def along(armature, bone, toward):
    a, b = (armature.matrix_world @ armature.pose.bones["mixamorig:" + n].head for n in (bone, toward))
    return list((b - a).normalized())

PAIRS = [(s + a, s + b) for s in ("Left", "Right") for a, b in
         (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))]
PAIRS = [pair for pair in PAIRS if all("mixamorig:" + name in shared for name in pair)]
root = next(b.name for b in subject.pose.bones if b.parent is None)
out = {"shared": shared, "pairs": PAIRS, "root": root, "ways": []}
first, last = (round(f) for f in subject.animation_data.action.frame_range)
for frame in range(first, last + 1):
    scene.frame_set(frame)
    bpy.context.view_layer.update()
    out["ways"].append([[along(armature, *pair) for pair in PAIRS] for armature in (subject, other)])
open(sys.argv[-1], "w").write(json.dumps(out))
"""


def retargeted(glb: Path, tmp_path: Path) -> dict:
    """Run the script in Blender; what it has measured."""
    command = blender()
    script, answer = tmp_path / "retarget.py", tmp_path / "answer.json"
    script.write_text(SCRIPT)
    between = ["--"] if command[-1] == "--python" else []
    done = subprocess.run(
        [*command, str(script), *between, str(glb), str(answer)], capture_output=True, text=True, timeout=300
    )
    check_answered(answer, done)
    return json.loads(answer.read_text())


def test_bones_of_another_person_point_where_the_subjects_do(tmp_path: Path) -> None:
    skeleton, _ = figure(read_template("human"), turn=0.7, speed=0.5)
    run = Run(tmp_path / "run")
    fields = ("joint_positions", "joint_bodies", "joint_names", "body_rotations", "body_positions", "fps")
    run.write_npz("skeleton.npz", **{name: getattr(skeleton, name) for name in fields})
    run.write_record({"source": {"up": "z"}})
    file = export_run(run, ["glb"], ExportSettings(name_set="mixamo", rest_pose="T")).files["glb"]
    found = retargeted(file, tmp_path)

    assert len(found["shared"]) == 15 and found["root"] == "mixamorig:Hips"
    ways = np.array(found["ways"])  # (T, 2, pairs, 3)
    assert len(ways) == skeleton.frame_count
    moved = np.rad2deg(np.arccos(np.clip((ways[:, 0] * ways[0, 0]).sum(-1), -1, 1))).max(axis=0)
    assert moved.min() > 5
    apart = np.rad2deg(2 * np.arcsin(np.linalg.norm(ways[:, 0] - ways[:, 1], axis=-1) / 2))
    assert apart.max() < 0.01, dict(zip(map(tuple, found["pairs"]), apart.max(axis=0).round(3), strict=True))
