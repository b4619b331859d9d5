"""Blender add-on: imports a geomocap run in one click (File > Import > geomocap run).

Surface and armature with the run's names from motion.glb, the cameras of its capture with their pictures as
backgrounds, and the ways of all joints as curves. Install: Edit > Preferences > Add-ons > Install from Disk, and choose
this file. It needs nothing but Blender (4.2 or newer).
"""

from __future__ import annotations

import json
import struct
import tomllib
from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Matrix, Quaternion, Vector

bl_info = {
    "name": "geomocap runs",
    "author": "the geomocap project",
    "version": (1, 0, 0),
    "blender": (4, 2, 0),
    "location": "File > Import > geomocap run",
    "description": "Imports a run of geomocap: surface, armature, cameras with pictures, trails",
    "category": "Import-Export",
}

# Blender's axes (z up) from those of a world whose axis x, y or z points up, by way of motion.glb (y up)
FROM_WORLD = {
    "z": Matrix.Identity(4),
    "y": Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1))),
    "x": Matrix(((0, 0, 1, 0), (0, -1, 0, 0), (1, 0, 0, 0), (0, 0, 0, 1))),
}
BLENDER_FROM_COLMAP = Matrix.Diagonal((1, -1, -1, 1))  # Blender's cameras look along -z, y up


class RunError(Exception):
    """A run or capture that can't be imported, in one line."""


def read_motion(path: Path) -> tuple[float, int]:
    """Return frames per second and number of frames of a GLB file's animation."""
    data = path.read_bytes()
    if data[:4] != b"glTF" or len(data) < 20:
        raise RunError(f"{path}: no GLB file")
    (length,) = struct.unpack_from("<I", data, 12)
    try:
        document = json.loads(data[20 : 20 + length])
        times = document["accessors"][document["animations"][0]["samplers"][0]["input"]]
        count, seconds = int(times["count"]), float(times["max"][0])
    except (ValueError, KeyError, IndexError) as error:
        raise RunError(f"{path}: holds no animation ({error})") from None
    return ((count - 1) / seconds if seconds > 0 else 25.0), count


def read_run(folder: Path) -> tuple[str, Path | None]:
    """Return the world axis that points up, and the capture that a run was made from if it is still there."""
    try:
        source = tomllib.loads((folder / "run.toml").read_text(encoding="utf-8")).get("source", {})
    except (OSError, ValueError) as error:
        raise RunError(f"{folder / 'run.toml'}: can't be read ({error})") from None
    capture = Path(str(source.get("path", "")))
    if "from_run" in source and not capture.exists():  # moved together with the run
        capture = folder / str(source["from_run"])
    up = str(source.get("up", "z"))
    found = source.get("kind") == "capture" and (capture / "capture.toml").is_file()
    return (up if up in FROM_WORLD else "z"), (capture if found else None)


def read_cameras(sparse: Path) -> list[dict]:
    """Return the cameras of a COLMAP model in text form: name, size, fx, fy, cx, cy, and world from camera."""
    interior = {}
    for line in _lines(sparse / "cameras.txt"):
        number, model, width, height, *values = line.split()
        p = [float(v) for v in values]
        one = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
        fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if one else p[:4]
        interior[number] = {"size": (int(width), int(height)), "f": (fx, fy), "c": (cx, cy)}
    cameras, seen = [], set()
    for line in _lines(sparse / "images.txt"):
        words = line.split()
        if len(words) < 10 or not words[9].strip() or words[8] not in interior:
            continue  # the lines of points between those of images
        name = words[9].split("/")[0] if "/" in words[9] else Path(words[9]).stem
        if name in seen:
            continue
        seen.add(name)
        cam_from_world = Matrix.LocRotScale(
            Vector([float(v) for v in words[5:8]]), Quaternion([float(v) for v in words[1:5]]), None
        )
        cameras.append({"name": name, "pose": cam_from_world.inverted(), **interior[words[8]]})
    return cameras


def _lines(path: Path) -> list[str]:
    try:
        return [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    except (OSError, ValueError):
        raise RunError(f"{path}: can't be read; cameras are imported from COLMAP models in text form") from None


def import_surface(folder: Path, scene: bpy.types.Scene) -> bpy.types.Object:
    """Import motion.glb at the recording's rate; return the armature."""
    fps, count = read_motion(folder / "motion.glb")
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(folder / "motion.glb"))
    made = [o for o in bpy.data.objects if o not in before]
    armature = next((o for o in made if o.type == "ARMATURE"), None)
    if armature is None:
        raise RunError(f"{folder / 'motion.glb'}: holds no skeleton")
    armature.name = folder.name
    start = round(armature.animation_data.action.frame_range[0]) if armature.animation_data else 0
    scene.frame_start, scene.frame_end = start, start + count - 1
    scene.frame_set(start)
    return armature


def import_cameras(capture: Path, up: str, scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Make a camera of each of the capture's, with its pictures as background, in step with the scene's frames."""
    collection = bpy.data.collections.new("cameras")
    scene.collection.children.link(collection)
    made = []
    for told in read_cameras(capture / "sparse"):
        data = bpy.data.cameras.new(told["name"])
        width, height = told["size"]
        longest = max(width, height)
        data.sensor_fit = "HORIZONTAL" if width >= height else "VERTICAL"
        data.sensor_width = data.sensor_height = 36.0
        data.lens = 36.0 * told["f"][0] / longest
        data.shift_x = (width / 2 - told["c"][0]) / longest
        data.shift_y = (told["c"][1] - height / 2) / longest
        data.display_size = 0.3
        camera = bpy.data.objects.new(told["name"], data)
        camera.matrix_world = FROM_WORLD[up] @ told["pose"] @ BLENDER_FROM_COLMAP
        collection.objects.link(camera)
        _set_background(data, capture, told["name"], scene)
        if not made:
            scene.camera = camera
            scene.render.resolution_x, scene.render.resolution_y = width, height
        made.append(camera)
    return made


def _set_background(data: bpy.types.Camera, capture: Path, name: str, scene: bpy.types.Scene) -> None:
    folder = capture / "images" / name
    pictures = sorted(p for p in folder.glob("*") if p.suffix.lower() in (".png", ".jpg", ".jpeg"))
    videos = sorted(capture.glob(f"videos/{name}.*"))
    if not pictures and not videos:
        return
    image = bpy.data.images.load(str(pictures[0] if pictures else videos[0]))
    image.name = name
    image.source = "SEQUENCE" if pictures else "MOVIE"
    background = data.background_images.new()
    background.image = image
    background.alpha = 0.7
    user = background.image_user
    user.frame_duration = len(pictures) or scene.frame_end - scene.frame_start + 1
    user.frame_start = scene.frame_start
    if pictures and pictures[0].stem.isdigit():
        user.frame_offset = int(pictures[0].stem) - 1
    user.use_auto_refresh = True
    data.show_background_images = True


def import_trails(armature: bpy.types.Object, scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Make a curve of each joint's way through all frames, called after its bone."""
    collection = bpy.data.collections.new("trails")
    scene.collection.children.link(collection)
    ways: dict[str, list[Vector]] = {bone.name: [] for bone in armature.pose.bones}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        for bone in armature.pose.bones:
            ways[bone.name].append(armature.matrix_world @ bone.matrix.translation)
    scene.frame_set(scene.frame_start)
    made = []
    for name, way in ways.items():
        curve = bpy.data.curves.new(f"{name} trail", "CURVE")
        curve.dimensions = "3D"
        curve.bevel_depth = 0.002
        spline = curve.splines.new("POLY")
        spline.points.add(len(way) - 1)
        spline.points.foreach_set("co", [v for point in way for v in (*point, 1.0)])
        trail = bpy.data.objects.new(f"{name} trail", curve)
        collection.objects.link(trail)
        made.append(trail)
    return made


def import_run(folder: Path, cameras: bool = True, trails: bool = True) -> list[str]:
    """Import a run into the scene; return what could not be had, a line each.

    Raises
    ------
    RunError
        If the run has no motion.glb, or it can't be read.
    """
    scene, missing = bpy.context.scene, []
    if not (folder / "motion.glb").is_file():
        raise RunError(f"{folder}: no motion.glb; is it the folder of a run? `geomocap export` makes the file")
    up, capture = read_run(folder) if (folder / "run.toml").is_file() else ("z", None)
    armature = import_surface(folder, scene)
    if cameras and capture is None:
        missing.append("the capture isn't there any more, so there are no cameras")
    elif cameras:
        try:
            import_cameras(capture, up, scene)
        except RunError as error:
            missing.append(str(error))
    if trails:
        import_trails(armature, scene)
    return missing


class IMPORT_SCENE_OT_geomocap(bpy.types.Operator, ImportHelper):
    """Import the folder of a geomocap run."""

    bl_idname = "import_scene.geomocap"
    bl_label = "Import geomocap run"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 (as Blender wants it)

    directory: StringProperty(name="Run", description="Folder of the run", subtype="DIR_PATH")
    filter_glob: StringProperty(default="*.toml;*.glb", options={"HIDDEN"})
    cameras: BoolProperty(name="Cameras", description="With their pictures as backgrounds", default=True)
    trails: BoolProperty(name="Trails", description="Ways of all joints, as curves", default=True)

    def execute(self, context):
        """Import the chosen folder."""
        try:
            for line in import_run(Path(bpy.path.abspath(self.directory)), self.cameras, self.trails):
                self.report({"WARNING"}, line)
        except RunError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


def _menu(self, context):
    self.layout.operator(IMPORT_SCENE_OT_geomocap.bl_idname, text="geomocap run (folder)")


def register():
    """Add the operator and its line in the menu."""
    bpy.utils.register_class(IMPORT_SCENE_OT_geomocap)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister():
    """Take them away."""
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    bpy.utils.unregister_class(IMPORT_SCENE_OT_geomocap)


if __name__ == "__main__":
    register()
