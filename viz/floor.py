"""The floor of free views: a metric grid and a soft contact shadow, drawn behind the subject."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from viz.rendering import PAPER
from viz.shapes import Mesh
from viz.viewpoints import PinholeView, ViewStage

LINE = (222, 225, 229)
SHADE = (120, 126, 135)
_VERTICES = 40_000  # about as many throw the shadow


def grid_spacing(diagonal: float) -> float:
    """Return the distance of grid lines, metres: 1, 2 or 5 times a power of ten, about a sixth of the diagonal."""
    power = 10.0 ** np.floor(np.log10(max(diagonal, 1e-6) / 6))
    return float(max(m for m in (1, 2, 5) if m * power <= diagonal / 6 + 1e-12) * power)


def floor(
    stage: ViewStage, view: PinholeView, meshes: Sequence[Mesh] = (), center: np.ndarray | None = None
) -> np.ndarray:
    """Draw the floor as a view sees it: (H, W, 3) uint8, RGB.

    Parameters
    ----------
    stage : ViewStage
    view : PinholeView
    meshes : sequence of Mesh
        What throws the shadow.
    center : (3,) float, optional
        Middle of the grid; the first frame's centre if not given.
    """
    width, height = view.size
    scale = 2
    image = np.full((height * scale, width * scale, 3), PAPER, np.float32)
    right = stage.broad
    ahead = np.cross(stage.up, right)
    middle = stage.centers[0] if center is None else np.asarray(center, float)
    base = middle - stage.up * (middle @ stage.up - stage.floor)
    basis = np.array([right, ahead])
    seen_from_below = view.cam_from_world[:, :3].T @ view.cam_from_world[:, 3] @ stage.up > -stage.floor
    if seen_from_below:
        return image[::scale, ::scale].astype(np.uint8)

    if meshes:
        _shadow(image, stage, view, meshes, base, basis, scale)
    step = grid_spacing(stage.diagonal)
    # The grid is fixed to the world: lines are at multiples of the step.
    origin = basis @ base
    reach = max(0.75 * stage.diagonal, 2 * step)
    first, last = np.floor((origin - reach) / step), np.ceil((origin + reach) / step)
    segments = []
    for k in range(2):
        along = np.linspace(first[1 - k], last[1 - k], 33) * step
        for i in np.arange(first[k], last[k] + 1) * step:
            flat = np.column_stack([np.full(33, i), along])[:, [0, 1] if k == 0 else [1, 0]]
            segments.append(np.stack([flat[:-1], flat[1:]], axis=1))
    flat = np.concatenate(segments).reshape(-1, 2)
    _lines(image, view, base + (flat - origin) @ basis, scale)
    return cv2.resize(np.clip(image, 0, 255).astype(np.uint8), (width, height), interpolation=cv2.INTER_AREA)


def _lines(image: np.ndarray, view: PinholeView, points: np.ndarray, scale: int) -> None:
    """Draw segments between each two of the points (2 N, 3) that lie in front of the view."""
    pixels = view.project(points)[0].reshape(-1, 2, 2)
    near = np.isfinite(pixels).all(axis=(1, 2))
    near[near] = (np.abs(pixels[near]) < 1e4).all(axis=(1, 2))
    ends = np.rint((pixels[near] * scale - 0.5) * 16).astype(np.int32)
    cv2.polylines(image, list(ends), False, LINE, 1, cv2.LINE_AA, 4)


def _shadow(
    image: np.ndarray,
    stage: ViewStage,
    view: PinholeView,
    meshes: Sequence[Mesh],
    base: np.ndarray,
    basis: np.ndarray,
    scale: int,
) -> None:
    """Darken the floor below the meshes, the more the nearer they are to it."""
    cells = 160
    reach = 0.75 * stage.diagonal
    vertices = np.concatenate([m.vertices for m in meshes])
    vertices = vertices[:: max(1, len(vertices) // _VERTICES)]
    flat = (vertices - base) @ basis.T
    height = (vertices - base) @ stage.up
    weight = np.exp(-np.maximum(height, 0) / (0.12 * stage.diagonal))
    index = np.floor((flat / reach + 1) / 2 * cells).astype(int)
    inside = ((index >= 0) & (index < cells)).all(axis=1)
    table = np.zeros((cells, cells), np.float32)
    np.maximum.at(table, (index[inside, 1], index[inside, 0]), weight[inside].astype(np.float32))
    table = 0.5 * cv2.GaussianBlur(table, (0, 0), 2.0) + 0.5 * cv2.GaussianBlur(table, (0, 0), 6.0)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float) * reach
    pixels, depth = view.project(base + corners @ basis)
    if (depth <= 0).any():
        return
    source = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], np.float32) - 0.5
    H = cv2.getPerspectiveTransform(source, (pixels * scale - 0.5).astype(np.float32))
    dark = cv2.warpPerspective(table, H, (image.shape[1], image.shape[0]))[..., None]
    image[:] = image + np.clip(0.55 * dark, 0, 1) * (np.array(SHADE, np.float32) - image)
