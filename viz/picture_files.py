"""Pictures of geometry files, whoever made them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh
from trimesh.visual import ColorVisuals

from geomocap.errors import GeometryError, RunError
from geomocap.files.frame_files import read_points
from geomocap.files.geometry_claims import check_geometry
from geomocap.files.open3d_geometry import read_by_open3d
from geomocap.files.scan_checks import check_points
from geomocap.files.scan_geometry import CLOUD_ENDINGS, MESH_ENDINGS, read_mesh
from geomocap.model.surface import vertex_normals
from geomocap.reading import open_plain
from viz.body_colors import body_colors
from viz.drawing import DENSITY, sheet, write_png
from viz.floor import floor
from viz.rendering import Model
from viz.shapes import Mesh
from viz.sheets import FINE, VIEWS, tile_size
from viz.viewpoints import stage_of, up_vector
from viz.volumes import cubes, gems, spacing

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def load(path: Path) -> Mesh:
    """Return what a geometry file holds as a mesh to look at: voxels as cubes, points as gems, meshes as they are.

    Point clouds with an integer attribute `body` come in the colours of their bodies.

    Raises
    ------
    GeometryError
        If the file is missing, of an unknown kind, or empty.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if not path.is_file():
        raise GeometryError(f"{path}: no such file")
    if ending not in {*MESH_ENDINGS, *CLOUD_ENDINGS}:
        raise GeometryError(f"{path}: can't be shown; expected {', '.join(sorted({*MESH_ENDINGS, *CLOUD_ENDINGS}))}")
    check_geometry(path)
    if ending == ".ply" and _is_voxel_grid(path):
        grid = read_by_open3d(o3d.io.read_voxel_grid, path)
        voxels = grid.get_voxels()
        if not voxels:
            raise GeometryError(f"{path}: holds no voxels; make it again")
        indices = np.array([v.grid_index for v in voxels]).reshape(-1, 3)
        colors = np.array([v.color for v in voxels]).reshape(-1, 3) * 255
        return cubes(indices, np.asarray(grid.origin), grid.voxel_size, colors)
    if ending in MESH_ENDINGS:
        found = read_mesh(path)
        if found is not None:
            return _triangles(found, path)
    if ending not in CLOUD_ENDINGS:
        raise GeometryError(f"{path}: holds no triangles; is it truncated?")
    try:
        points = read_points(path).finite
    except GeometryError:
        raise GeometryError(f"{path}: holds neither triangles nor points; is it whole?") from None
    check_points(points.positions, str(path))
    colors = body_colors(points.body) if (points.body >= 0).any() else points.shown_colors
    return gems(points.positions, colors, 0.75 * spacing(points.positions), points.normals)


def _is_voxel_grid(path: Path) -> bool:
    with open_plain(path) as file:
        return b"voxel_size" in file.read(4096).split(b"end_header")[0]


def _triangles(found: trimesh.Trimesh, path: Path) -> Mesh:
    vertices, faces = np.asarray(found.vertices, float), np.asarray(found.faces).astype(np.int64)
    good = np.isfinite(vertices[faces]).all(axis=(1, 2))
    kept = np.unique(faces[good])
    check_points(vertices[kept], str(path))
    a, b, c = vertices[faces[good]].swapaxes(0, 1)
    if not np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() > 0:
        raise GeometryError(f"{path}: its triangles have no area; is it whole?")
    vertices, faces = np.where(np.isfinite(vertices), vertices, vertices[kept[0]]), faces[good]
    colors = np.full((len(faces), 3), (0.62, 0.66, 0.72))
    visual = found.visual
    if isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[faces][..., :3].mean(axis=1) / 255
    return Mesh(vertices, faces, vertex_normals(vertices, faces), colors)


def render_file(path: Path, picture: Path | None = None, up: str = "z") -> Path:
    """Write a picture of a geometry file from four sides, without a screen.

    Parameters
    ----------
    path : Path
        PLY (voxel grid, points or mesh), PCD, XYZ, PTS, OBJ, STL, OFF or GLB.
    picture : Path, optional
        Where to write it, as PNG or whatever its ending says; beside the file, with the ending .png, if not given.
    up : {"x", "y", "z"}
        World axis that points up.

    Returns
    -------
    Path
        The picture.

    Raises
    ------
    GeometryError
        If the file holds nothing that can be shown.
    RunError
        If the picture can't be written, or its name isn't that of a picture.
    """
    path = Path(path)
    target = path.with_suffix(".png") if picture is None else Path(picture)
    if target.suffix.lower() not in PICTURES:
        raise RunError(f"{target}: no name of a picture; expected one of the endings {', '.join(PICTURES)}")
    mesh = load(path)
    stage = stage_of([mesh.vertices], [0], 1, up_vector(up))
    model = Model([mesh])
    tiles: list[np.ndarray | None] = []
    for angles in VIEWS.values():
        view = stage.view(*angles, tile_size(stage, *angles, 160_000 * DENSITY**2))
        tiles.append(model.render(view, FINE, stage.up).above(floor(stage, view, model.meshes)).clear())
    write_png(target, sheet([tiles], (), tuple(VIEWS)))
    return target
