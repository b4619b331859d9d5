"""URDF with a mesh for every link, for robots' tools and simulators; z up, metres, radians.

The root link is the base: simulators let it float. A ball is three revolute joints in a row, about z, x and y, with
links without mass between them. Limits are those seen; effort isn't known. `motion_joints.csv` has the base's pose (x,
y, z in metres and a quaternion x, y, z, w) and the joints' positions in every frame.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from geomocap.export.conventions import Convention
from geomocap.export.linked_bodies import LinkBody, LinkedBodies
from geomocap.export.stl import write_stl
from geomocap.export.tables import write_csv
from geomocap.files.atomic import write_text
from geomocap.model.rotations import quaternions, zxy_angles

URDF = Convention("z", "m")
MESHES = "urdf_meshes"
EFFORT = 1000.0  # nothing is known of forces; the format wants a number
AXES = {"z": (0.0, 0.0, 1.0), "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}


def write_urdf(path: Path, bodies: LinkedBodies) -> None:
    """Write a URDF, its meshes in a folder beside it, and `motion_joints.csv`; each whole or not at all.

    Parameters
    ----------
    path : Path
    bodies : LinkedBodies
        In the axes of `URDF`.
    """
    robot = Xml.Element("robot", name=path.stem)
    for link in bodies.links:
        mesh = ""
        if len(link.triangles):
            mesh = f"{MESHES}/{safe_name(link.name)}.stl"
            write_stl(path.parent / mesh, link.vertices, link.triangles)
        _add_link(robot, link, mesh)
    for link in bodies.links[1:]:
        _add_joints(robot, link, safe_name(bodies.links[link.parent].name), bodies.fps)
    Xml.indent(robot)
    write_text(path, '<?xml version="1.0"?>\n' + Xml.tostring(robot, encoding="unicode") + "\n")
    write_csv(path.with_name("motion_joints.csv"), joint_table(bodies))


def joint_table(bodies: LinkedBodies) -> dict[str, np.ndarray]:
    """Return the pose of the base and the joints' positions, columns (T,)."""
    frames = np.arange(len(bodies.root))
    columns: dict[str, np.ndarray] = {"frame": frames, "time_s": frames / bodies.fps}
    for i, axis in enumerate("xyz"):
        columns[f"base_{axis}_m"] = bodies.root[:, i]
    turned = quaternions(bodies.links[0].turns)
    for i, axis in enumerate("xyzw"):
        columns[f"base_q{axis}"] = turned[:, i]
    for link in bodies.links[1:]:
        columns |= _positions(link)
    return columns


def safe_name(name: str) -> str:
    """Return a name as XML formats and file systems bear it."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-.") else "_" for c in name)


def _positions(link: LinkBody) -> dict[str, np.ndarray]:
    name = safe_name(link.joint_name)
    if link.axis is not None:
        return {name: link.turns}
    return {f"{name}_{axis}": angle for axis, angle in zip(AXES, zxy_angles(link.turns).T, strict=True)}


def _add_link(robot: Xml.Element, link: LinkBody, mesh: str) -> None:
    element = Xml.SubElement(robot, "link", name=safe_name(link.name))
    inertial = Xml.SubElement(element, "inertial")
    Xml.SubElement(inertial, "origin", xyz=_numbers(link.center), rpy="0 0 0")
    Xml.SubElement(inertial, "mass", value=f"{link.mass:.6g}")
    i = link.inertia
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    Xml.SubElement(inertial, "inertia", {name: f"{i[k]:.6g}" for name, k in names.items()})
    for kind in ("visual", "collision") if mesh else ():
        shape = Xml.SubElement(element, kind)
        Xml.SubElement(shape, "origin", xyz="0 0 0", rpy="0 0 0")
        Xml.SubElement(Xml.SubElement(shape, "geometry"), "mesh", filename=mesh)


def _add_joints(robot: Xml.Element, link: LinkBody, parent: str, fps: float) -> None:
    """Add one revolute joint for a hinge, three for a ball."""
    name, columns = safe_name(link.name), _positions(link)
    axes = [link.axis] if link.axis is not None else [np.array(a) for a in AXES.values()]
    for k, ((joint, angles), axis) in enumerate(zip(columns.items(), axes, strict=True)):
        child = name if k == len(axes) - 1 else f"{name}_{'zx'[k]}"
        if child != name:
            Xml.SubElement(robot, "link", name=child)
        element = Xml.SubElement(robot, "joint", name=joint, type="revolute")
        Xml.SubElement(element, "parent", link=parent)
        Xml.SubElement(element, "child", link=child)
        Xml.SubElement(element, "origin", xyz=_numbers(link.offset if k == 0 else np.zeros(3)), rpy="0 0 0")
        Xml.SubElement(element, "axis", xyz=_numbers(axis))
        speed = float(np.abs(np.diff(angles)).max(initial=0.0)) * fps
        limits = {"lower": f"{angles.min():.6f}", "upper": f"{angles.max():.6f}"}
        Xml.SubElement(element, "limit", limits | {"effort": f"{EFFORT:g}", "velocity": f"{speed:.6f}"})
        parent = child


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.9g}" for v in values)
