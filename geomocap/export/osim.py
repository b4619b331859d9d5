"""OpenSim model and motion: bodies with their surfaces, hinges and balls as found, a free root; y up, metres, radians.

A hinge is a PinJoint about z of its frames, a ball a BallJoint, the root a FreeJoint; the last two have body-fixed
angles X, Y, Z as coordinates, called after the joint with _rx, _ry, _rz (and _tx, _ty, _tz).
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.export.angle_files import mot_text
from geomocap.export.conventions import Convention
from geomocap.export.linked_bodies import LinkBody, LinkedBodies
from geomocap.export.stl import write_stl
from geomocap.export.urdf import safe_name
from geomocap.files.atomic import write_text
from geomocap.model.rotations import zxy_angles

OSIM = Convention("y", "m")
MESHES = "Geometry"
VERSION = "40000"
GRAVITY = "0 -9.80665 0"
# A cyclic change of axes turns X Y Z body-fixed angles into Z X Y ones.
_CYCLE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def write_osim(path: Path, bodies: LinkedBodies) -> None:
    """Write a model, its meshes in `Geometry/` beside it, and the motion as `.mot`; each whole or not at all.

    Parameters
    ----------
    path : Path
    bodies : LinkedBodies
        In the axes of `OSIM`.
    """
    document = Xml.Element("OpenSimDocument", Version=VERSION)
    model = Xml.SubElement(document, "Model", name=path.stem)
    _text(model, "gravity", GRAVITY)
    _text(model, "length_units", "meters")
    _text(model, "force_units", "N")
    body_set = Xml.SubElement(Xml.SubElement(model, "BodySet", name="bodyset"), "objects")
    joint_set = Xml.SubElement(Xml.SubElement(model, "JointSet", name="jointset"), "objects")
    for link in bodies.links:
        mesh = ""
        if len(link.triangles):
            mesh = f"{safe_name(link.name)}.stl"
            write_stl(path.parent / MESHES / mesh, link.vertices, link.triangles)
        _add_body(body_set, link, mesh)
        parent = "/ground" if link.parent < 0 else f"/bodyset/{safe_name(bodies.links[link.parent].name)}"
        _add_joint(joint_set, link, parent)
    Xml.indent(document)
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(document, encoding="unicode") + "\n")
    columns = coordinates(bodies)
    times = np.arange(len(bodies.root)) / bodies.fps
    table = np.stack(list(columns.values()), axis=1)
    write_text(path.with_suffix(".mot"), mot_text(path.stem, tuple(columns), times, table, degrees=False))


def coordinates(bodies: LinkedBodies) -> dict[str, np.ndarray]:
    """Return the coordinates of all joints, (T,) each, radians and metres."""
    columns: dict[str, np.ndarray] = {}
    for link in bodies.links:
        columns |= {name: values for name, values in zip(_names(link), _values(link, bodies.root), strict=True)}
    return columns


def xyz_angles(rotations: np.ndarray) -> np.ndarray:
    """Body-fixed angles of R = Rx(a) Ry(b) Rz(c), (T, 3) radians, that run on smoothly, of rotations (T, 3, 3)."""
    return zxy_angles(_CYCLE @ rotations @ _CYCLE.T)


def _names(link: LinkBody) -> list[str]:
    name = safe_name(link.joint_name)
    if link.axis is not None:
        return [name]
    turns = [f"{name}_r{a}" for a in "xyz"]
    return turns if link.parent >= 0 else [*turns, *(f"{name}_t{a}" for a in "xyz")]


def _values(link: LinkBody, root: np.ndarray) -> list[np.ndarray]:
    if link.axis is not None:
        return [link.turns]
    angles = list(xyz_angles(link.turns).T)
    return angles if link.parent >= 0 else [*angles, *root.T]


def _add_body(objects: Xml.Element, link: LinkBody, mesh: str) -> None:
    body = Xml.SubElement(objects, "Body", name=safe_name(link.name))
    if mesh:
        shapes = Xml.SubElement(body, "attached_geometry")
        shape = Xml.SubElement(shapes, "Mesh", name=f"{safe_name(link.name)}_surface")
        _text(shape, "socket_frame", "..")
        _text(shape, "mesh_file", mesh)
    i = link.inertia
    _text(body, "mass", f"{link.mass:.6g}")
    _text(body, "mass_center", _numbers(link.center))
    _text(body, "inertia", _numbers(np.array([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]])))


def _add_joint(objects: Xml.Element, link: LinkBody, parent: str) -> None:
    kind = "FreeJoint" if link.parent < 0 else "BallJoint" if link.axis is None else "PinJoint"
    name = safe_name(link.joint_name)
    joint = Xml.SubElement(objects, kind, name=f"{name}_joint")
    _text(joint, "socket_parent_frame", f"{name}_before")
    _text(joint, "socket_child_frame", f"{name}_after")
    listed = Xml.SubElement(joint, "coordinates")
    values = _values(link, np.zeros((1, 3)))
    for label, angles in zip(_names(link), values, strict=True):
        coordinate = Xml.SubElement(listed, "Coordinate", name=label)
        _text(coordinate, "default_value", "0")
        low, high = (-100.0, 100.0) if label[-3:-1] == "_t" else (float(angles.min()), float(angles.max()))
        _text(coordinate, "range", f"{low:.6f} {high:.6f}")
        _text(coordinate, "clamped", "false")
    frames = Xml.SubElement(joint, "frames")
    turn = _numbers(_orientation(link))
    for label, socket, place in (
        (f"{name}_before", parent, link.offset),
        (f"{name}_after", f"/bodyset/{safe_name(link.name)}", np.zeros(3)),
    ):
        frame = Xml.SubElement(frames, "PhysicalOffsetFrame", name=label)
        _text(frame, "socket_parent", socket)
        _text(frame, "translation", _numbers(place))
        _text(frame, "orientation", turn)


def _orientation(link: LinkBody) -> np.ndarray:
    """Body-fixed angles X, Y, Z of the frames of a joint: a hinge turns about their z."""
    if link.axis is None:
        return np.zeros(3)
    turn, _ = Rotation.align_vectors(link.axis[None], np.array([[0.0, 0, 1]]))
    return xyz_angles(turn.as_matrix()[None])[0]


def _text(parent: Xml.Element, tag: str, text: str) -> None:
    Xml.SubElement(parent, tag).text = text


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.9g}" for v in values)
