"""Rigid links with joints between them, as simulators hold a motion: hinges with their axes, balls, and a free root."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from geomocap.export.conventions import Convention
from geomocap.export.motion_tree import MotionTree
from geomocap.export.skinned_mesh import SkinnedMesh
from geomocap.model.rotations import rotation_vectors
from geomocap.skeleton.hinges import main_axis

HINGE_WITHIN = 0.0005  # m: a joint is a hinge if its link's surface would be nowhere farther off


@dataclass(frozen=True)
class LinkBody:
    """One link, in its own axes: its joint to the parent is the origin, its axes are the file's in the first frame.

    Attributes
    ----------
    name, joint_name : str
    parent : int
        -1 for the root, which moves freely.
    offset : (3,) float, metres
        Of the joint in the parent's axes; of the root 0.
    axis : (3,) float or None
        Of a hinge; None: a ball, or the root.
    turns : (T,) or (T, 3, 3) float
        Of a hinge, radians; else rotations, parent from link.
    vertices : (V, 3) float, metres
    triangles : (F, 3) int
    mass : float, kilograms
    center : (3,) float, metres
        Of mass.
    inertia : (3, 3) float, kg m²
        About the centre of mass.
    """

    name: str
    joint_name: str
    parent: int
    offset: np.ndarray
    axis: np.ndarray | None
    turns: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    mass: float
    center: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class LinkedBodies:
    """Links, parents before children, and the way of the root.

    Attributes
    ----------
    links : tuple of LinkBody
    root : (T, 3) float, metres
        Origin of the root in the file's axes.
    fps : float
    """

    links: tuple[LinkBody, ...]
    root: np.ndarray
    fps: float


def linked_bodies(
    motion: MotionTree,
    mesh: SkinnedMesh | None,
    joint_names: tuple[str, ...],
    convention: Convention,
    *,
    density: float,
    radius: float,
) -> LinkedBodies:
    """Make links of a motion with fixed joints.

    Parameters
    ----------
    motion : MotionTree
        Made with `joints="fixed"`.
    mesh : SkinnedMesh, optional
        Every link has the triangles that follow it most; without it, links are balls at the ends of their bones.
    joint_names : tuple of str
        Of the skeleton's joints.
    convention : Convention
        Axes of the file; its unit must be metres.
    density : float, kg / m³
        Masses are those of the convex hulls of the links' surfaces.
    radius : float, metres
        Of a link without a surface.
    """
    turned = motion.converted(convention)
    origins = turned.forward_kinematics()[1][0]
    vertices = np.zeros((0, 3)) if mesh is None else convention.points(mesh.posed(motion)[0], motion.up)
    main = np.zeros(0, int) if mesh is None else mesh.nodes[np.arange(len(mesh.nodes)), mesh.weights.argmax(axis=1)]
    links = []
    for n in range(turned.n_nodes):
        mine, triangles = _part_of(vertices, main, mesh, n)
        mine = mine - origins[n]
        if len(mine) < 4:
            end = np.zeros(3) if np.isnan(turned.tips[n]).any() else turned.tips[n] / 2
            mine = end + radius * np.concatenate([np.eye(3), -np.eye(3)])
            triangles = np.zeros((0, 3), int)
        mass, center, inertia = solid_properties(mine, density)
        joint = int(turned.joints[n])
        link = LinkBody(
            name=turned.names[n],
            joint_name=joint_names[joint] if joint >= 0 else "root",
            parent=int(turned.parents[n]),
            offset=turned.offsets[n] if n else np.zeros(3),
            axis=None,
            turns=turned.rotations[:, n],
            vertices=mine,
            triangles=triangles,
            mass=mass,
            center=center,
            inertia=inertia,
        )
        links.append(link if n == 0 else _as_hinge(link))
    return LinkedBodies(tuple(links), turned.translations[:, 0], turned.fps)


def solid_properties(points: np.ndarray, density: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre and inertia about it of the convex hull of points, by its tetrahedra.

    Parameters
    ----------
    points : (N, 3) float, metres
    density : float, kg / m³
    """
    try:
        hull = ConvexHull(points)
    except QhullError:  # flat: a little thickness is added
        size = max(float(np.ptp(points, axis=0).max()), 1e-3)
        points = np.concatenate([points, points.mean(axis=0) + 0.01 * size * np.concatenate([np.eye(3), -np.eye(3)])])
        hull = ConvexHull(points)
    inside = points[hull.vertices].mean(axis=0)
    corners = points[hull.simplices] - inside
    volumes = np.abs(np.linalg.det(corners)) / 6
    volume = float(volumes.sum())
    means = corners.sum(axis=1) / 4
    center = volumes @ means / volume
    # second moments of a tetrahedron with a corner at 0: V/20 (Σ x xᵀ + Σx Σxᵀ)
    total = corners.sum(axis=1)
    second = np.einsum("k,kai,kaj->ij", volumes, corners, corners) + np.einsum("k,ki,kj->ij", volumes, total, total)
    second = density * (second / 20 - volume * np.outer(center, center))
    inertia = np.trace(second) * np.eye(3) - second
    return density * volume, inside + center, inertia


def _part_of(
    vertices: np.ndarray, main: np.ndarray, mesh: SkinnedMesh | None, node: int
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles that follow a node most."""
    if mesh is None:
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    mine = mesh.triangles[(main[mesh.triangles] == node).sum(axis=1) >= 2]
    used, again = np.unique(mine, return_inverse=True)
    return vertices[used], again.reshape(-1, 3)


def _as_hinge(link: LinkBody) -> LinkBody:
    """Return a link as one on a hinge if it turns about one axis only."""
    if Rotation.from_matrix(link.turns).magnitude().max() < 1e-9:
        return replace(link, axis=np.array([0.0, 0, 1]), turns=np.zeros(len(link.turns)))
    since = link.turns[0].T @ link.turns
    axis = main_axis(since, np.ones(len(since)))
    angles = rotation_vectors(link.turns[:, None])[:, 0] @ axis
    off = Rotation.from_matrix(link.turns) * Rotation.from_rotvec(angles[:, None] * axis).inv()
    lever = float(np.linalg.norm(link.vertices, axis=1).max())
    return replace(link, axis=axis, turns=angles) if off.magnitude().max() * lever <= HINGE_WITHIN else link
