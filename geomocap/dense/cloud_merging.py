"""Clouds of several templates become one without double layers.

Each template's measurement is a depth map. A point is compared with every other template's map where it projects into
it: the same surface, in front of it (the other camera sees through the point), or hidden behind it. Of a surface that
several templates measured, the one that looks at it most directly with most images is kept; a point through which
more templates see than agree with it is dropped (visibility as in Merrell et al. 2007, "Real-time visibility-based
fusion of depth maps").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.dense.dense_settings import MergeSettings
from geomocap.dense.measured_points import MeasuredPoints
from geomocap.matching.growing import MatchGrid
from geomocap.model.rig import Rig


@dataclass(frozen=True)
class CloudLayer:
    """What one template measured.

    Attributes
    ----------
    points : MeasuredPoints
        N points.
    cells : (N,) int
        Their cells in the grid.
    grid : MatchGrid
    planes : (M, 3) float
        Inverse depth and slopes of all cells.
    template : int
        Camera.
    """

    points: MeasuredPoints
    cells: np.ndarray
    grid: MatchGrid
    planes: np.ndarray
    template: int


def merge(layers: list[CloudLayer], rig: Rig, settings: MergeSettings | None = None) -> list[np.ndarray]:
    """Say which points of each layer belong to the merged cloud.

    Parameters
    ----------
    layers : list of CloudLayer
    rig : Rig
        Pinhole cameras.
    settings : MergeSettings, optional

    Returns
    -------
    list of (N,) bool, one for each layer
    """
    settings = settings or MergeSettings()
    if len(layers) == 1:
        return [np.ones(len(layers[0].points), bool)]
    scores = [_score(layer, rig) for layer in layers]
    maps = [_score_map(layer, score) for layer, score in zip(layers, scores, strict=True)]
    kept = []
    for i, layer in enumerate(layers):
        count = len(layer.points)
        support, against = np.zeros(count, int), np.zeros(count, int)
        worse = np.zeros(count, bool)
        depth = rig.to_camera(layer.points.positions)
        pixels = rig.project(layer.points.positions)
        for j, other in enumerate(layers):
            if j == i:
                continue
            cell, offset = _cell_at(other, pixels[other.template])
            known = cell >= 0
            known[known] &= maps[j][cell[known]] > -np.inf
            n = np.flatnonzero(known)
            c = cell[n]
            mu = other.planes[c, 0] + np.einsum("ni,ni->n", other.planes[c, 1:3], offset[n])
            surface = 1 / np.maximum(mu, 1e-6)
            z = depth[other.template, n, 2]
            spacing = other.grid.step * z / rig.cameras[other.template].mean_focal_length()
            # Where either looks at the surface at a slant, a step in the image is a long way in depth
            slant = np.linalg.norm(other.planes[c, 1:3], axis=1) * other.grid.step / np.maximum(mu, 1e-6) * z
            tolerance = settings.distance or (3 * spacing + 3 * layer.points.sigma[n] + slant)
            same = np.abs(z - surface) <= tolerance
            support[n] += same
            against[n] += z < surface - 2 * tolerance
            rival = maps[j][c]
            better = (rival > scores[i][n]) | ((rival == scores[i][n]) & (j < i))
            worse[n] |= same & better
        keep = ~worse
        if settings.support:
            keep &= against <= support
        kept.append(keep)
    return kept


def _score(layer: CloudLayer, rig: Rig) -> np.ndarray:
    """How well a template sees its points: cosine of the angle of incidence, times the number of views."""
    ray = rig.centers[layer.template] - layer.points.positions
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    return np.einsum("ni,ni->n", ray, layer.points.normals) * layer.points.views


def _score_map(layer: CloudLayer, score: np.ndarray) -> np.ndarray:
    """Scores of all cells, -inf where there is no point."""
    image = np.full(len(layer.grid), -np.inf)
    image[layer.cells] = score
    return image


def _cell_at(layer: CloudLayer, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cell nearest to each pixel (N, 2), -1 where there is none, and the way from it to the pixel."""
    number = layer.grid.image(np.arange(len(layer.grid)), -1)
    with np.errstate(invalid="ignore"):
        place = np.rint((pixels - 0.5) / layer.grid.step - 0.5)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((place >= 0) & (place < np.array(number.shape)[::-1])).all(axis=1))
    cell = np.full(len(pixels), -1, np.int64)
    column, row = place[inside].astype(int).T
    cell[inside] = number[row, column]
    offset = np.zeros((len(pixels), 2))
    found = cell >= 0
    offset[found] = pixels[found] - layer.grid.pixels[cell[found]]
    return cell, offset
