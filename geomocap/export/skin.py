"""The subject's own surface as a skin: meshed in a reference frame, moved by the bodies that its points belong to."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.motion_tree import MotionTree
from geomocap.export.skinned_mesh import INFLUENCES, SkinnedMesh
from geomocap.files.frame_files import read_points, read_voxels
from geomocap.files.run import Run
from geomocap.model.skeleton import body_names
from geomocap.model.surface import Surface, surface_through

VOTERS = 15  # points that say which body a vertex belongs to
STEP = 0.5  # of the diffusion: the fraction of its neighbours' mean that a vertex takes on


def skin_from_run(run: Run, motion: MotionTree, settings: ExportSettings) -> SkinnedMesh:
    """Mesh a run's surface in the reference frame and bind it to the motion.

    Parameters
    ----------
    run : Run
        With `bodies/`; for true colours with `voxels/` or `cloud/`.
    motion : MotionTree
    settings : ExportSettings

    Raises
    ------
    MotionError
        If the frame has no bodies, or the surface can't be made.
    """
    frame = settings.skin_frame
    file = run.frame_file("bodies", frame)
    if frame >= motion.n_frames or not file.is_file():
        raise MotionError(f"{file}: missing; the skin needs a frame that was segmented (export.skin_frame)")
    read = read_points(file)
    points, labels, colors, normals = read.positions, read.body, read.shown_colors, read.normals
    if not (labels >= 0).any():
        raise MotionError(f"{file}: no point belongs to a body; choose another reference frame (export.skin_frame)")
    if settings.skin_colors == "true":
        colors = _true_colors(run, frame, points)
    surface = surface_through(points, normals, settings.skin_triangles)
    diagonal = float(np.ptp(points, axis=0).max())
    known = labels >= 0
    body = majority(points[known], labels[known], surface.vertices)
    nodes, weights = skin_weights(surface, node_of_body(motion, body), motion.n_nodes, settings.skin_blend * diagonal)
    if settings.skin_colors == "true":
        tint = colors[cKDTree(points).query(surface.vertices)[1]]
    else:
        tint = _body_tints(labels[known], colors[known])[body]
    return SkinnedMesh(surface.vertices, surface.normals, surface.triangles, tint, nodes, weights, frame)


def majority(points: np.ndarray, labels: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Label that most of the nearest points have, at each place, so that single wrong labels don't tear the skin.

    Parameters
    ----------
    points : (N, 3) float
    labels : (N,) int, 0 or more
    places : (M, 3) float

    Returns
    -------
    (M,) int
    """
    k = min(VOTERS, len(points))
    nearest = cKDTree(points).query(places, k=k)[1].reshape(len(places), k)
    votes = np.zeros((len(places), int(labels.max()) + 1), np.int16)
    np.add.at(votes, (np.arange(len(places))[:, None], labels[nearest]), 1)
    return votes.argmax(axis=1)


def _body_tints(labels: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Median colour of each body's points, (bodies, 3) uint8."""
    tints = np.zeros((int(labels.max()) + 1, 3), np.uint8)
    for b in np.unique(labels):
        tints[b] = np.median(colors[labels == b], axis=0)
    return tints


def skin_weights(surface: Surface, node: np.ndarray, n_nodes: int, blend: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights that fall off smoothly where two bodies meet, by diffusion of the labels over the surface.

    On a mesh of edge e, a step of half the neighbours' mean spreads by e²/4 in variance, so `blend` metres take
    4 (blend / e)² steps. Diffusion runs along the surface: a hand that rests on a thigh doesn't pull at it.

    Parameters
    ----------
    surface : Surface
    node : (V,) int
        Node that each vertex belongs to.
    n_nodes : int
    blend : float, metres
        Standard deviation of the blending.

    Returns
    -------
    nodes : (V, 4) int
    weights : (V, 4) float
        The four largest, summing to one.
    """
    f, v = surface.triangles, len(surface.vertices)
    edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    length = float(np.linalg.norm(np.diff(surface.vertices[edges], axis=1), axis=-1).mean())
    both = np.concatenate([edges, edges[:, ::-1]])
    adjacent = sparse.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(v, v))
    adjacent.data[:] = 1
    degree = np.maximum(np.asarray(adjacent.sum(axis=1)).ravel(), 1)
    step = sparse.diags(1 / degree) @ adjacent * STEP + sparse.eye(v) * (1 - STEP)
    weight = np.zeros((v, n_nodes))
    weight[np.arange(v), node] = 1
    for _ in range(int(np.ceil(4 * (blend / length) ** 2))):
        weight = step @ weight
    most = min(INFLUENCES, n_nodes)
    nodes, weights = np.zeros((v, INFLUENCES), int), np.zeros((v, INFLUENCES))
    nodes[:, :most] = np.argsort(-weight, axis=1, kind="stable")[:, :most]
    weights[:, :most] = np.take_along_axis(weight, nodes[:, :most], axis=1)
    weights[weights < 0.01 * weights[:, :1]] = 0
    return nodes, weights / weights.sum(axis=1, keepdims=True)


def node_of_body(motion: MotionTree, bodies: np.ndarray) -> np.ndarray:
    """Nodes of the motion that are these bodies, (N,) int."""
    table = np.full(max(int(motion.bodies.max()), int(bodies.max(initial=0))) + 1, -1)
    table[motion.bodies[motion.bodies >= 0]] = np.flatnonzero(motion.bodies >= 0)
    nodes = table[bodies]
    if (nodes < 0).any():
        lost = body_names(int(bodies.max()) + 1)[bodies[nodes < 0][0]]
        raise MotionError(f"skin: {lost} has points but no place in skeleton.npz; run again")
    return nodes


def _true_colors(run: Run, frame: int, points: np.ndarray) -> np.ndarray:
    """Colours of the nearest voxels, or cloud points, of the frame: (N, 3) uint8."""
    if (file := run.frame_file("voxels", frame)).is_file():
        voxels = read_voxels(file)
        places, colors = voxels.points, voxels.colors
    else:
        file = run.frame_file("cloud", frame)
        cloud = read_points(file) if file.is_file() else None
        if cloud is None or cloud.colors is None:
            raise MotionError(f'{file}: no colours there; keep skin_colors = "body"')
        places, colors = cloud.positions, cloud.colors
    return colors[cKDTree(places).query(points)[1]]
