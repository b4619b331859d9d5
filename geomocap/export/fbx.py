"""FBX by Blender's own exporter, from the GLB: only where Blender is installed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from geomocap.export.export_errors import MissingPackageError, MotionError
from geomocap.files.atomic import write_atomic

# Run by Blender's Python with the two files as the last arguments.
SCRIPT = """
import bpy, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
fps = float(sys.argv[-1])
bpy.context.scene.render.fps = max(1, round(fps))
bpy.context.scene.render.fps_base = max(1, round(fps)) / fps
bpy.ops.import_scene.gltf(filepath=sys.argv[-3])
for shown in [o for o in bpy.data.objects if o.type == "MESH" and not o.modifiers]:
    bpy.data.objects.remove(shown)  # the importer's own picture of a bone
last = max((a.frame_range[1] for a in bpy.data.actions), default=1)
bpy.context.scene.frame_start, bpy.context.scene.frame_end = 0, round(last)
bpy.ops.export_scene.fbx(filepath=sys.argv[-2], add_leaf_bones=False, bake_anim_simplify_factor=0.0)
"""

_ERROR = re.compile(r"\w+(Error|Exception): ")  # of Blender's Python, which may take several lines


def write_fbx(path: Path, glb: Path, fps: float) -> None:
    """Convert a GLB into an FBX, whole or not at all.

    Parameters
    ----------
    path, glb : Path
    fps : float

    Raises
    ------
    MissingPackageError
        If there is no Blender, as a program or as the package bpy.
    MotionError
        If Blender fails.
    """
    write_atomic(path, lambda p: _convert(p, glb, fps, path.name))


def _convert(path: Path, glb: Path, fps: float, name: str) -> None:
    program = shutil.which("blender")
    if program is not None:
        start = [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python-expr", SCRIPT, "--"]
    elif find_spec("bpy") is not None:
        start = [sys.executable, "-c", SCRIPT]
    else:
        raise MissingPackageError(
            "FBX files are made by Blender; install it (or the package bpy), or import motion.glb where FBX is needed"
        )
    done = subprocess.run([*start, str(glb.resolve()), str(path.resolve()), f"{fps:g}"], capture_output=True, text=True)
    if done.returncode or not path.is_file():
        lines = (done.stderr.strip() or done.stdout.strip() or "it said nothing").splitlines()
        said = next((line for line in reversed(lines) if _ERROR.match(line)), lines[-1])
        raise MotionError(f"{name}: Blender could not write it ({said}); import motion.glb instead")
