"""The floor of free views: a metric grid and a soft contact shadow, drawn behind the subject."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from viz.rendering import Layer
from viz.shapes import Mesh
from viz.viewpoints import PinholeView, ViewStage

LINE = (135, 143, 153, 0.27)
"""Colour and opacity of the grid's lines; they show on light and dark pages."""
SHADE = 0.3
"""Opacity of the shadow where it is darkest."""
_VERTICES = 40_000  # about as many throw the shadow


def grid_spacing(diagonal: float) -> float:
    """Return the distance of grid lines, metres: 1, 2 or 5 times a power of ten, about a sixth of the diagonal."""
    power = 10.0 ** np.floor(np.log10(max(diagonal, 1e-6) / 6))
    return float(max(m for m in (1, 2, 5) if m * power <= diagonal / 6 + 1e-12) * power)


def floor(stage: ViewStage, view: PinholeView, meshes: Sequence[Mesh] = (), center: np.ndarray | None = None) -> Layer:
    """Draw the floor as a view sees it, clear but for its lines and the shadow.

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
    dark = np.zeros((height, width), np.float32)
    right = stage.broad
    ahead = np.cross(stage.up, right)
    middle = stage.centers[0] if center is None else np.asarray(center, float)
    base = middle - stage.up * (middle @ stage.up - stage.floor)
    basis = np.array([right, ahead])
    seen_from_below = view.cam_from_world[:, :3].T @ view.cam_from_world[:, 3] @ stage.up > -stage.floor
    if seen_from_below:
        return Layer(np.zeros((height, width, 4), np.float32))

    if meshes:
        dark = _shadow(dark.shape, stage, view, meshes, base, basis)
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
    line = np.float32(LINE[3]) * _lines((height, width), view, base + (flat - origin) @ basis)
    rgba = np.empty((height, width, 4), np.float32)
    for c in range(3):
        rgba[..., c] = line * np.float32(LINE[c] / 255)  # the shadow is black
    rgba[..., 3] = line + (1 - line) * dark
    return Layer(rgba)


def _lines(shape: tuple[int, int], view: PinholeView, points: np.ndarray, scale: int = 2) -> np.ndarray:
    """Draw segments between each two of the points (2 N, 3) that lie in front of the view: (H, W) float32, 0 to 1."""
    pixels = view.project(points)[0].reshape(-1, 2, 2)
    near = np.isfinite(pixels).all(axis=(1, 2))
    near[near] = (np.abs(pixels[near]) < 1e4).all(axis=(1, 2))
    ends = np.rint((pixels[near] * scale - 0.5) * 16).astype(np.int32)
    drawn = np.zeros((shape[0] * scale, shape[1] * scale), np.uint8)
    cv2.polylines(drawn, list(ends), False, 255, 1, cv2.LINE_8, 4)
    return np.asarray(cv2.resize(drawn, shape[::-1], interpolation=cv2.INTER_AREA)) / np.float32(255)


def _shadow(
    shape: tuple[int, int],
    stage: ViewStage,
    view: PinholeView,
    meshes: Sequence[Mesh],
    base: np.ndarray,
    basis: np.ndarray,
) -> np.ndarray:
    """Darkness (H, W) of the floor below the meshes, 0 to 1, the more the nearer they are to it."""
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
        return np.zeros(shape, np.float32)
    source = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], np.float32) - 0.5
    H = cv2.getPerspectiveTransform(source, (pixels - 0.5).astype(np.float32))
    dark = cv2.warpPerspective(table, H, (shape[1], shape[0]))
    return SHADE * np.clip(dark, 0, 1)
