"""Meshes of a run's frames: volume, bodies, ellipsoids, skeleton, paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomocap.model.frame_geometry import Voxels
from viz import body_colors as palette
from viz.run_contents import Results
from viz.shapes import EMPTY, Mesh, ball, bone, ellipsoid, join, tube
from viz.viewpoints import ViewStage, stage_of, up_vector
from viz.volumes import black_cubes, gems, skin, spacing

GLASS = (128, 146, 168)
"""Colour of the translucent volume, RGB 0–255."""


def stage(results: Results, samples: int = 10) -> ViewStage:
    """Find where a run's motion takes place, from some of its frames.

    Raises
    ------
    GeometryError
        If the run holds no geometry.
    """
    count = len(results.frames)
    places = sorted({round(p) for p in np.linspace(0, count - 1, min(samples, count))}) if count else []
    clouds = [results.any_points(results.frames[p]) for p in places]
    return stage_of(clouds, places, max(count, 1), up_vector(results.up))


def volume(results: Results, frame: int) -> Mesh:
    """Return a frame's voxels as cubes in their colours, or its cloud as points."""
    if results.has("voxels", frame):
        grid = results.voxels(frame)
        return _cubes(results, frame, grid, grid.indices, grid.colors)
    if results.has("cloud", frame):
        return cloud(results, frame)
    return EMPTY


def _cubes(results: Results, frame: int, grid: Voxels, indices: np.ndarray, colors: np.ndarray) -> Mesh:
    """Voxels (N, 3) int of a frame's grid as cubes in colours (N, 3) uint8; they are built once for all colours."""

    def build() -> tuple[np.ndarray, Mesh, np.ndarray]:
        return indices, *black_cubes(indices, grid.origin, grid.voxel_size)

    known, mesh, voxel = results.kept.value(("cubes", frame), build)
    if not np.array_equal(known, indices):
        _, mesh, voxel = build()
    return replace(mesh, colors=colors[voxel] / 255.0)


def cloud(results: Results, frame: int) -> Mesh:
    """Return a frame's cloud as points in their colours."""
    if not results.has("cloud", frame):
        return EMPTY
    c = results.cloud(frame)
    return gems(c.positions, c.shown_colors, 0.75 * spacing(c.positions), c.normals)


def bodies(results: Results, frame: int) -> Mesh:
    """Return a frame's points, or voxels, in the colours of their bodies."""
    if not results.has("bodies", frame):
        return EMPTY
    b = results.bodies(frame)
    colors = palette.body_colors(b.body)
    if results.has("voxels", frame):
        grid = results.voxels(frame)
        indices = np.floor((b.positions - grid.origin) / grid.voxel_size).astype(int)
        return replace(_cubes(results, frame, grid, indices, colors), outlined=True)
    return replace(gems(b.positions, colors, 0.75 * spacing(b.positions), b.normals), outlined=True)


def body_skin(results: Results, frame: int) -> Mesh:
    """Return the skin that pictures of a frame show; see `rough_skin`."""
    return results.kept.value(("skin", frame), lambda: rough_skin(results, frame, 110))


def rough_skin(results: Results, frame: int, cells: int) -> Mesh:
    """Return a smooth skin around a frame's points in the colours of the bodies, or in one colour without bodies.

    It has at most so many cells along its longest side.
    """
    if results.has("bodies", frame):
        b = results.bodies(frame)
        return skin(b.positions, palette.body_colors(b.body), cells)
    points = results.any_points(frame)
    return skin(points, np.tile(np.array(GLASS, np.uint8), (len(points), 1)), cells)


def glass(mesh: Mesh) -> Mesh:
    """Return a skin as glass that lets a skeleton be seen."""
    return mesh.recolored(GLASS).translucent(0.16, 0.5)


def ellipsoids(results: Results, frame: int) -> Mesh:
    """Return a frame's ellipsoids in the colours of their bodies."""
    e = results.ellipsoids
    if e is None:
        return EMPTY
    place = results.place(frame)
    whole = np.isfinite(e.centers[place]).all(axis=1) & np.isfinite(e.radii[place]).all(axis=1)
    return join(
        [
            ellipsoid(
                e.centers[place, k], e.radii[place, k], e.rotations[place, k], palette.body_color(e.bodies[k]), level=4
            )
            for k in np.flatnonzero(whole)
        ]
    )


def skeleton(results: Results, frame: int, size: float, outline_points: bool = True) -> list[Mesh]:
    """Return a frame's skeleton: bones in the colours of their bodies, dark balls for joints.

    A body at the end of a chain gets a bone from its joint to the far end of its points.

    Parameters
    ----------
    results : Results
    frame : int
    size : float
        Extent of the subject, metres; the bones' thickness follows from it.
    outline_points : bool
        Read the frame's body points to find the far ends; otherwise such bones end at the body's centre.
    """
    s = results.skeleton
    if s is None:
        return []
    place = results.place(frame)
    thick = 0.011 * size
    points = results.bodies(frame) if outline_points and results.has("bodies", frame) else None
    meshes = []
    for body, joint, child in s.bones:
        meshes.append(_bone(s.place(place, body, joint), s.joint_positions[place, child], thick, body))
    for body in s.leaves:
        joint = int(s.hierarchy.body_joints[body])
        if joint < 0:
            continue
        start, end = s.joint_positions[place, joint], s.body_positions[place, body]
        if points is not None:
            end = _far_end(start, end, points.positions[points.body == body])
        meshes.append(_bone(start, end, thick, body))
    for position in s.joint_positions[place]:
        if np.isfinite(position).all():
            meshes.append(ball(position, 1.05 * thick, palette.INK, level=3))
    return meshes


def _bone(start: np.ndarray, end: np.ndarray, thick: float, body: int) -> Mesh:
    length = float(np.linalg.norm(end - start))
    if not np.isfinite(length) or length < 1e-6:
        return EMPTY
    return bone(start, end, min(thick, 0.25 * length), palette.body_color(body))


def _far_end(start: np.ndarray, middle: np.ndarray, points: np.ndarray) -> np.ndarray:
    axis = middle - start
    length = np.linalg.norm(axis)
    if len(points) < 4 or length < 1e-9:
        return middle
    along = (points - start) @ (axis / length)
    return start + axis / length * max(float(np.percentile(along, 96)), float(length))


def paths(results: Results, size: float, first: int = 0, last: int | None = None) -> Mesh:
    """Return the paths of the ellipsoids' centres (else of the joints) over places first … last of the sequence."""
    e, s = results.ellipsoids, results.skeleton
    if e is not None:
        positions, owners = e.centers, e.bodies
    elif s is not None:
        positions, owners = s.joint_positions, s.joint_bodies[:, 1]
    else:
        return EMPTY
    part = positions[first:last]
    tubes = [tube(part[:, k], 0.003 * size, palette.body_color(int(owners[k])), sides=6) for k in range(part.shape[1])]
    return replace(join(tubes), outlined=False)
