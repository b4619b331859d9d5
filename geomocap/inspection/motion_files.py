"""Motion files, described."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.export.bvh import read_bvh
from geomocap.export.c3d import read_c3d
from geomocap.export.markers import Markers
from geomocap.export.motion_tree import MotionTree
from geomocap.export.trc import read_trc
from geomocap.inspection.description import Description, count, shortened
from geomocap.reading import read_bytes, reason

ENDINGS = (".bvh", ".trc", ".c3d", ".glb")
EXTENTS = (0.05, 20.0)  # m; subjects beyond are likely in other units
FASTEST = 50.0  # m/s


def describe_motion_file(path: Path) -> Description:
    """Describe a BVH, TRC, C3D or GLB file."""
    told = Description(path, "motion file")
    try:
        match path.suffix.lower():
            case ".bvh":
                motion = read_bvh(path)
                told.fact("format", "BVH, turning joints; it can't state axes and unit, y up and metres taken")
                _tell_tree(motion, told)
                _tell_points(Markers(motion.names, motion.forward_kinematics()[1], motion.fps, "y"), told)
            case ".trc":
                told.fact("format", "TRC, markers; it can't state axes, y up taken")
                _tell_points(read_trc(path), told)
            case ".c3d":
                told.fact("format", "C3D, markers")
                _tell_points(read_c3d(path), told)
            case _:
                _tell_glb(path, told)
    except GeomocapError as error:
        told.problem(error)
    return told


def _tell_tree(motion: MotionTree, told: Description) -> None:
    told.fact("joints", f"{motion.n_nodes}: {shortened(list(motion.names))}")
    moving = [n for k, n in enumerate(motion.names) if motion.moving[k] and motion.parents[k] >= 0]
    if moving:
        told.fact("joints that shift", shortened(moving))
    lengths = np.linalg.norm(motion.offsets[1:], axis=1)
    if len(lengths):
        told.fact("bone lengths", f"{lengths.min():.3f} to {lengths.max():.3f} m")


def _tell_points(markers: Markers, told: Description) -> None:
    seconds = markers.n_frames / markers.fps
    told.fact("frames", f"{markers.n_frames} at {markers.fps:g} per second, {seconds:.2f} s")
    told.fact("points", f"{len(markers.names)}: {shortened(list(markers.names))}")
    told.fact("up", markers.up)
    present = markers.present
    if not present.any():
        told.problem("no point has a position in any frame")
        return
    low, high = np.nanmin(markers.positions, axis=(0, 1)), np.nanmax(markers.positions, axis=(0, 1))
    told.fact("range", " · ".join(f"{a} {lo:.3f} to {hi:.3f} m" for a, lo, hi in zip("xyz", low, high, strict=True)))
    told.fact("gaps", f"{100 * (1 - present.mean()):.1f} %")
    seen = present.any(axis=1)
    boxes = np.nanmax(markers.positions[seen], axis=1) - np.nanmin(markers.positions[seen], axis=1)
    diagonal = float(np.median(boxes.max(axis=1)))
    if len(markers.names) > 1 and not EXTENTS[0] <= diagonal <= EXTENTS[1]:
        told.problem(f"the points span {diagonal:.4g} m: the file's lengths are likely in another unit")
    ever: list[bool] = np.any(present, axis=0).tolist()
    never = [n for n, p in zip(markers.names, ever, strict=True) if not p]
    if never:
        told.problem(f"{count(len(never), 'point')} without any position: {shortened(never)}")
    speed = np.linalg.norm(np.diff(markers.positions, axis=0), axis=-1) * markers.fps
    if np.isfinite(speed).any() and np.nanmax(speed) > FASTEST:
        frame, point = np.unravel_index(np.nanargmax(speed), speed.shape)
        told.problem(f"{markers.names[point]} moves at {speed[frame, point]:.0f} m/s after frame {frame}: it jumps")


def _tell_glb(path: Path, told: Description) -> None:
    try:
        data = read_bytes(path)
    except OSError as error:
        told.problem(f"{path}: can't be read ({error.strerror or error})")
        return
    if len(data) < 20 or data[:4] != b"glTF":
        told.problem(f"{path}: no GLB file, it doesn't begin with glTF; export it again")
        return
    version, length, chunk = struct.unpack("<III", data[4:16])
    told.fact("format", f"GLB (binary glTF {version}), y up, m")
    if length != len(data):
        told.problem(f"{path}: says {length} bytes, has {len(data)}; it was cut off")
        return
    try:
        document = json.loads(data[20 : 20 + chunk])
        names = [document["nodes"][j].get("name", "?") for s in document.get("skins", []) for j in s["joints"]]
        told.fact("joints", f"{len(names)}: {shortened(names)}" if names else "none")
        corners = [p["attributes"]["POSITION"] for m in document.get("meshes", []) for p in m["primitives"]]
        told.fact("vertices", sum(document["accessors"][a]["count"] for a in corners))
        for animation in document.get("animations", []):
            ends = [document["accessors"][s["input"]] for s in animation["samplers"]]
            seconds = max((e["max"][0] for e in ends), default=0.0)
            keys = max((e["count"] for e in ends), default=0)
            told.fact(
                f"animation {animation.get('name', '')}",
                f"{keys} key frames, {seconds:.2f} s",
            )
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        told.problem(f"{path}: its JSON is damaged ({reason(error)}); export it again")
        return
    if not names:
        told.problem("it has no skin: there is no skeleton in it")
    if not document.get("animations"):
        told.problem("it has no animation: nothing moves")
