"""The moving subject of a report: `motion.glb` and what is drawn beside it, as text that a page carries along.

`templates/turntable.js` draws it. All coordinates are those of GLB files: y up, metres.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pygltflib
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError, RunError
from geomocap.export.conventions import GLB, Axis
from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.glb import glb_bytes
from geomocap.export.motion_tree import MotionTree
from geomocap.export.run_export import FILES, mean_radius, surface_of_run
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.skinned_mesh import bone_mesh
from geomocap.model.skeleton import Skeleton
from geomocap.reading import read_bytes
from geomocap.subject.subject_model import MODEL_FILE, read_model
from viz.body_colors import body_color, hex_color
from viz.camera_pictures import frusta
from viz.floor import grid_spacing
from viz.run_contents import Results
from viz.shown_angles import angles_of, angles_of_node
from viz.shown_names import joint_names, names_of, trunk_of
from viz.viewpoints import ViewStage

SAMPLES = 40_000
"""Places of followed points that are shown at most, over all frames."""

VIEW_DEG = (35.0, 12.0)
"""Azimuth and elevation of the first view."""

_LEVELS = 65_534  # of quantised places; 65535: not seen


@dataclass(frozen=True)
class Turntable:
    """What a page needs to draw the subject in three dimensions.

    Attributes
    ----------
    data : str
        JSON that can stand inside a script element.
    glb : str
        The file, in base 64.
    """

    data: str
    glb: str


def turntable(results: Results, stage: ViewStage) -> Turntable | None:
    """Return the moving subject of a run; None if it has no skeleton or its motion can't be used.

    Parameters
    ----------
    results : Results
    stage : ViewStage
        Where the motion takes place.
    """
    skeleton = results.skeleton
    if skeleton is None:
        return None
    try:
        motion = motion_of(results, skeleton)
        glb = glb_of(results, motion)
    except (MotionError, GeometryError, RunError):
        return None  # the report is about the rest then
    data = {
        **_places(results, stage, motion),
        "nodes": _nodes(results, skeleton, motion),
        "tracks": _tracks(results, motion),
        "keypoints": _keypoints(results, motion.up),
        "colors": _own_colors(results, glb, motion.up),
        **frusta(results, motion.up),
    }
    return Turntable(script_json(data), base64.b64encode(glb).decode())


def script_json(data: Any) -> str:
    """Return JSON that can stand inside a script element, whatever names it holds."""
    words = json.dumps(data, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        words = words.replace(character, f"\\u{ord(character):04x}")
    return words


def motion_of(results: Results, skeleton: Skeleton) -> MotionTree:
    """Return the motion as the run's files have it: a node for each body, in the order of the GLB file."""
    up: Axis = {"x": "x", "y": "y"}.get(results.up, "z")  # type: ignore[assignment]
    radius, root = mean_radius(results.run), trunk_of(results, skeleton)
    return motion_from_skeleton(skeleton, up=up, names=names_of(results), radius=radius, root=root)


def glb_of(results: Results, motion: MotionTree) -> bytes:
    """Return `motion.glb`; made anew if it isn't there, is of another skeleton, or shows no surface."""
    file = results.run.path / FILES["glb"]
    if file.is_file() and (results.run.path / MODEL_FILE).is_file() and _is_of(data := read_bytes(file), motion):
        return data
    try:
        mesh = surface_of_run(results.run, motion, ExportSettings(surface="skin"))
    except (MotionError, GeometryError, RunError):
        mesh = None  # bones show the motion, too
    return glb_bytes(motion, mesh or bone_mesh(motion))


def _is_of(data: bytes, motion: MotionTree) -> bool:
    """Whether a GLB file holds this motion, whatever its nodes are called: as many frames, nodes in their places."""
    try:
        found = pygltflib.GLTF2.load_from_bytes(data)
        if found is None or not found.skins or not found.animations:
            return False
        places = np.array([found.nodes[n].translation for n in found.skins[0].joints], float)
        frames = found.accessors[found.animations[0].samplers[0].input].count
    except Exception:  # a file from anywhere: whatever is wrong, another one is made
        return False
    expected = motion.converted(GLB).translations[0]
    same = places.shape == expected.shape and np.allclose(places, expected, atol=1e-4)
    return bool(same) and frames == motion.n_frames


def _places(results: Results, stage: ViewStage, motion: MotionTree) -> dict[str, Any]:
    """Where and when: frames, floor, how large the subject is, what the first view must take in."""
    azimuth, elevation = np.radians(VIEW_DEG)
    front = np.cross(stage.broad, stage.up)
    flat = np.cos(azimuth) * front + np.sin(azimuth) * stage.broad
    view = np.cos(elevation) * flat + np.sin(elevation) * stage.up
    moving = np.ptp(stage.centers, axis=0).max() > 1e-6
    centers = stage.centers if moving else stage.centers[:1]
    points = stage.points + stage.centers[0]
    chosen = points[np.linspace(0, len(points) - 1, min(len(points), 400)).astype(int)]
    chosen = np.concatenate([chosen, points[points.argmin(axis=0)], points[points.argmax(axis=0)]])
    frames = results.frames if len(results.frames) == motion.n_frames else list(range(motion.n_frames))
    height = (stage.points + stage.centers[0]) @ stage.up

    def shown(values: np.ndarray) -> list[Any]:
        return np.round(GLB.points(values, motion.up), 4).tolist()

    return {
        "fps": motion.fps,
        "frames": frames,
        "diagonal": stage.diagonal,
        "floor": round(stage.floor, 4),
        "middle": round(float((height.min() + height.max()) / 2), 4),
        "step": grid_spacing(stage.diagonal),
        "view": shown(view),
        "centers": shown(centers),
        "points": shown(chosen),
    }


def _nodes(results: Results, skeleton: Skeleton, motion: MotionTree) -> list[dict[str, Any]]:
    """Return what is told of each body and of the joint to its parent."""
    found = results.diagnostics
    known_angles = angles_of(results)
    sure, std, hinge = found.body_confidence, found.joint_std, found.joint_is_hinge
    called = joint_names(results, skeleton)
    tips = GLB.points(motion.tips, motion.up)
    nodes = []
    for n, name in enumerate(motion.names):
        body, j = int(motion.bodies[n]), int(motion.joints[n])
        joint: dict[str, Any] | None = None
        told: list[dict[str, Any]] = []
        if j >= 0:
            if known_angles is not None:
                told = angles_of_node(known_angles[0], int(motion.bodies[motion.parents[n]]), body)
            precise = std is not None and len(std) == skeleton.joint_count and np.isfinite(std[j]).all()
            kind = "joint" if hinge is None or len(hinge) != skeleton.joint_count else ("hinge" if hinge[j] else "ball")
            joint = {
                "name": called[j],
                "kind": kind,
                "std": 1000 * float(np.linalg.norm(std[j])) if std is not None and precise else None,
            }
        known = sure is not None and 0 <= body < len(sure) and bool(np.isfinite(sure[body]))
        nodes.append(
            {
                "name": name,
                "parent": int(motion.parents[n]),
                "color": hex_color(body_color(body)),
                "confidence": round(float(sure[body]), 3) if sure is not None and known else None,
                "joint": joint,
                "angles": told,
                "tip": np.round(tips[n], 5).tolist() if np.isfinite(tips[n]).all() else None,
            }
        )
    return nodes


def _tracks(results: Results, motion: MotionTree) -> dict[str, Any] | None:
    """Return some of the points that were followed, quantised, each with the node of its body (-1: unknown)."""
    found = results.diagnostics
    positions, bodies = found.sample_positions, found.sample_body
    if positions is None or positions.ndim != 3 or positions.shape[1] != motion.n_frames or not len(positions):
        return None
    count = min(len(positions), 500, max(1, SAMPLES // motion.n_frames))
    chosen = np.sort(np.random.default_rng(0).permutation(len(positions))[:count])
    places = GLB.points(positions[chosen].astype(float), motion.up).swapaxes(0, 1)  # (T, N, 3)
    seen = np.isfinite(places).all(axis=2)
    if not seen.any():
        return None
    low = places[seen].min(axis=0)
    step = max(float(np.ptp(places[seen], axis=0).max()) / _LEVELS, 1e-9)
    quantised = np.full(places.shape, 65_535, np.uint16)
    quantised[seen] = np.rint((places[seen] - low) / step).astype(np.uint16)
    nodes = np.full(count, -1)
    if bodies is not None and len(bodies) == len(positions):
        node_of = np.full(int(max(motion.bodies.max(), bodies.max())) + 2, -1)  # the last one stands for body -1
        node_of[motion.bodies] = np.arange(motion.n_nodes)
        nodes = node_of[bodies[chosen]]
    return {"count": count, "low": low.tolist(), "step": step, "places": _base64(quantised), "nodes": nodes.tolist()}


def _keypoints(results: Results, up: Axis) -> list[dict[str, Any]]:
    """Return the key-points of a run with their places in every frame."""
    points = results.keypoints
    if points is None:
        return []
    places = GLB.points(points.paths.positions, up)
    return [
        {
            "name": name,
            "radius": float(radius),
            "places": [np.round(p, 4).tolist() if np.isfinite(p).all() else None for p in places[:, k]],
        }
        for k, (name, radius) in enumerate(zip(points.names, points.radius, strict=True))
    ]


def _own_colors(results: Results, glb: bytes, up: Axis) -> str | None:
    """Return the subject's own colours at the vertices of the file, from the nearest points of its model."""
    file = results.run.path / MODEL_FILE
    if not file.is_file():
        return None
    try:
        model = read_model(file)
    except (GeometryError, RunError):
        return None
    if not len(model.colors):
        return None
    document = pygltflib.GLTF2.load_from_bytes(glb)
    accessor = document.accessors[document.meshes[0].primitives[0].attributes.POSITION]
    view = document.bufferViews[accessor.bufferView]
    start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
    blob = document.binary_blob()
    vertices = np.frombuffer(blob, np.float32, 3 * accessor.count, start).reshape(-1, 3).astype(float)
    nearest = cKDTree(GLB.points(model.points, up)).query(vertices)[1]
    return _base64(model.colors[nearest])


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
