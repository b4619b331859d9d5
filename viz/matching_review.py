"""Pictures of surface measurement: matched points, Voronoi regions and shifts, clouds from several sides, errors."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from geomocap.dense.dense_frame import CloudFrame, TemplateCloud
from geomocap.matching.growing import SurfaceMatches
from geomocap.model.ray_casting import TriangleScene
from viz.body_colors import ACCENT, INK, body_color
from viz.drawing import DENSITY, faded, on_paper, sheet, text_width, write_on
from viz.viewpoints import look

PARTLY = (230, 130, 20)
"""Points that not all search images saw."""

REMOVED = (150, 15, 45)
"""Points that disagreed with their neighbours."""

_LOW, _MIDDLE, _HIGH = (34, 94, 168), (250, 240, 180), (178, 24, 43)


def matched_picture(image: np.ndarray, surface: SurfaceMatches, width: int = 900) -> np.ndarray:
    """Draw the template with its matched points: seen in all search images, in some, removed, and the seeds.

    Parameters
    ----------
    image : (H, W, 3) uint8
        Template image without distortion (`geomocap.dense.undistorted_color`).
    surface : SurfaceMatches
    width : int
        Width of the picture, pixels; the picture is cut to what was matched.

    Returns
    -------
    (h, w, 3) uint8
    """
    canvas, place, scale = _cut(image, surface, width, 0.45)
    size = max(1, round(0.33 * scale))
    everywhere = surface.seen.all(axis=1)
    for which, color in (
        (surface.removed, REMOVED),
        (surface.matched & ~everywhere, PARTLY),
        (everywhere, ACCENT),
    ):
        _dots(canvas, place(surface.grid.pixels[which]), size, color)
    for x, y in place(surface.seeds.pixels):
        cv2.circle(canvas, (x, y), size + 3, INK, DENSITY, cv2.LINE_AA)
    words = (
        (f"{int(everywhere.sum())} in all images", ACCENT),
        (f"{int((surface.matched & ~everywhere).sum())} in some", PARTLY),
        (f"{int(surface.removed.sum())} removed", REMOVED),
        (f"{len(surface.seeds)} seeds", INK),
    )
    return _captioned(canvas, words)


def regions_picture(image: np.ndarray, surface: SurfaceMatches, width: int = 900) -> np.ndarray:
    """Draw the Voronoi regions of the seeds and the shifts in them: along the seed's row, then up and down.

    Parameters and result as in `matched_picture`.
    """
    canvas, place, scale = _cut(image, surface, width, 0.6)
    grid, region = surface.grid, surface.region
    at = place(grid.pixels)
    half = max(1, int(np.ceil(scale * np.diff(np.unique(grid.pixels[:, 0])).min(initial=2.0) / 2)))
    tint = canvas.copy()
    for (x, y), r in zip(at, region, strict=True):
        if r >= 0:
            cv2.rectangle(tint, (x - half, y - half), (x + half, y + half), body_color(int(r) % 24), -1)
    canvas = cv2.addWeighted(canvas, 0.6, tint, 0.4, 0)
    right, below = grid.neighbours[:, 1], grid.neighbours[:, 3]
    begin = np.array([_seed_row(surface, s) for s in range(len(surface.seeds))], dtype=int)
    for cell in np.flatnonzero(surface.matched):
        in_row = region[cell] >= 0 and grid.row[cell] == begin[region[cell]]
        for other, wanted in ((right[cell], in_row), (below[cell], True)):
            if wanted and other >= 0 and surface.matched[other] and region[other] == region[cell]:
                cv2.line(canvas, tuple(at[cell]), tuple(at[other]), INK, 1, cv2.LINE_AA)
    for x, y in place(surface.seeds.pixels):
        cv2.circle(canvas, (x, y), max(3, round(scale)), (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(canvas, (x, y), max(3, round(scale)), INK, 1, cv2.LINE_AA)
    return _captioned(canvas, ((f"{len(surface.seeds)} Voronoi regions", INK),))


def shifts_picture(image: np.ndarray, surface: SurfaceMatches, search: int = 0, width: int = 900) -> np.ndarray:
    """Draw where the points lie in search image `search` of the group, as a picture of their disparity.

    Each matched point is coloured by the length of the way from its template position to its counterpart, from the
    shortest (blue) to the longest (red). Parameters and result otherwise as in `matched_picture`.
    """
    canvas, place, scale = _cut(image, surface, width, 0.6)
    seen = surface.seen[:, search]
    way = np.linalg.norm(surface.matches.positions[seen, search] - surface.grid.pixels[seen], axis=1)
    low, high = (float(v) for v in np.quantile(way, [0.02, 0.98])) if len(way) else (0.0, 1.0)
    colors = scale_colors((way - low) / max(high - low, 1e-9))
    size = max(1, int(np.ceil(0.6 * scale * surface.grid.step)))
    for (x, y), color in zip(place(surface.grid.pixels[seen]), colors.tolist(), strict=True):
        cv2.circle(canvas, (x, y), size, color, -1)
    return _captioned(canvas, ((f"shift {low:.1f} px", _LOW), (f"to {high:.1f} px", _HIGH)))


def cloud_picture(
    points: np.ndarray,
    colors: np.ndarray,
    azimuth_deg: float,
    elevation_deg: float = 10.0,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    size: tuple[int, int] = (300 * DENSITY, 420 * DENSITY),
) -> np.ndarray:
    """Draw a cloud from one side, the nearer points before the farther ones.

    Parameters
    ----------
    points : (N, 3) float, metres
    colors : (N, 3) uint8
    azimuth_deg, elevation_deg : float
        Direction of the view about the upward axis and above the horizon, degrees.
    up : (3,) float
    size : (int, int)
        Width and height, pixels.

    Returns
    -------
    (height, width, 3) uint8
    """
    width, height = size
    picture = np.full((height, width, 3), 255, np.uint8)
    if len(points) == 0:
        return picture
    axis = np.asarray(up, float)
    east = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [0.0, 0.0, 1.0], axis)
    east /= np.linalg.norm(east)
    north = np.cross(axis, east)
    a, e = np.radians([azimuth_deg, elevation_deg])
    direction = np.cos(e) * (np.sin(a) * east - np.cos(a) * north) + np.sin(e) * axis
    low, high = np.quantile(points, [0.002, 0.998], axis=0)
    middle = (low + high) / 2
    pose = look(middle + direction, middle, axis)
    seen = points @ pose[:, :3].T + pose[:, 3]
    # A parallel projection, so that all sides have one scale
    span = [max(float(np.linalg.norm((high - low)[:2])), 1e-9), max(float(np.linalg.norm(high - low)), 1e-9)]
    scale = 0.46 * min(width / span[0], 2 * height / span[1])
    x = np.rint(seen[:, 0] * scale * 2 + width / 2).astype(int)
    y = np.rint(seen[:, 1] * scale * 2 + height / 2).astype(int)
    spacing = np.sqrt((high - low).max() * np.median(high - low) / max(len(points), 1)) * scale * 2
    reach = int(np.clip(np.ceil(spacing), 1, 4 * DENSITY))
    order = np.argsort(-seen[:, 2], kind="stable")
    for dy in range(reach):
        for dx in range(reach):
            column, row = x[order] + dx, y[order] + dy
            inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
            picture[row[inside], column[inside]] = np.asarray(colors)[order][inside]
    return picture


def cloud_sheet(
    points: np.ndarray,
    colors: np.ndarray,
    azimuths_deg: Sequence[float] = (-60, -20, 20, 60),
    up: Sequence[float] = (0.0, 0.0, 1.0),
    size: tuple[int, int] = (300 * DENSITY, 420 * DENSITY),
) -> np.ndarray:
    """Return a cloud from several sides, in a row: (H, W, 3) uint8. Parameters as in `cloud_picture`."""
    pictures = [cloud_picture(points, colors, a, up=up, size=size) for a in azimuths_deg]
    return sheet([pictures], (), [f"{a:g}°" for a in azimuths_deg], framed=True)


def surface_errors(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed distances of points (N, 3) from a closed true surface, outside positive: (N,) float, metres."""
    if len(points) == 0:
        return np.zeros(0)
    nearest, _, _, normals = TriangleScene(vertices, faces).closest(points)
    way = np.asarray(points) - nearest
    side = np.einsum("ni,ni->n", way, normals)
    return np.where(side >= 0, 1.0, -1.0) * np.linalg.norm(way, axis=1)


def scale_colors(values: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8 for values from 0 (blue) over 0.5 (pale) to 1 (red)."""
    t = np.clip(np.nan_to_num(np.asarray(values, float)), 0, 1)
    channels = [np.interp(t, [0, 0.5, 1], c) for c in zip(_LOW, _MIDDLE, _HIGH, strict=True)]
    return np.rint(np.column_stack(channels)).astype(np.uint8)


def error_sheet(
    points: np.ndarray,
    errors: np.ndarray,
    limit: float,
    azimuths_deg: Sequence[float] = (-60, -20, 20, 60),
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> np.ndarray:
    """Return a cloud from several sides, coloured by its signed errors (N,), from −limit (blue) to limit (red), m."""
    picture = cloud_sheet(points, scale_colors(0.5 + 0.5 * errors / limit), azimuths_deg, up)
    size = np.abs(errors)
    words = (
        f"median |error| {np.median(size) * 1e3:.2f} mm, 99 % {np.quantile(size, 0.99) * 1e3:.2f} mm"
        if len(size)
        else ""
    )
    return _captioned(picture, ((f"−{limit * 1e3:.1f} mm", _LOW), (f"+{limit * 1e3:.1f} mm", _HIGH), (words, INK)))


def template_sheet(image: np.ndarray, cloud: TemplateCloud, width: int = 460 * DENSITY) -> np.ndarray:
    """Return matched points, regions and shifts of one template, side by side: (H, W, 3) uint8."""
    surface = cloud.surface
    pictures = [
        matched_picture(image, surface, width),
        regions_picture(image, surface, width),
        shifts_picture(image, surface, 0, width),
    ]
    return sheet([pictures], (), ["matched points", "regions and shifts", "disparity"], framed=True)


def frame_sheet(
    frame: CloudFrame, azimuths_deg: Sequence[float] = (-60, -20, 20, 60), up: Sequence[float] = (0.0, 0.0, 1.0)
) -> np.ndarray:
    """Return a frame's cloud from several sides: in its colours, and by the template that measured it."""
    p = frame.points
    by_template = np.array([body_color(t) for t in range(int(p.template.max(initial=0)) + 1)], np.uint8)[p.template]
    looks = {"colour": p.colors}
    if len(frame.templates) > 1:
        looks["template"] = by_template.reshape(-1, 3)
    rows = [[cloud_picture(p.positions, colors, a, up=up) for a in azimuths_deg] for colors in looks.values()]
    return sheet(rows, list(looks), [f"{a:g}°" for a in azimuths_deg], framed=True)


def _cut(image: np.ndarray, surface: SurfaceMatches, width: int, fade: float):
    """Cut the image to what was matched, scale and fade it; also return the way from pixels to it, and its scale."""
    shown = surface.matched if surface.matched.any() else np.ones(len(surface.grid), bool)
    pixels = surface.grid.pixels[shown] if len(surface.grid) else np.array([[0.0, 0.0], image.shape[1::-1]])
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 6, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 7, image.shape[1::-1])
    scale = width / (high[0] - low[0])
    part = image[low[1] : high[1], low[0] : high[0]]
    canvas = cv2.resize(part, (width, round(scale * part.shape[0])), interpolation=cv2.INTER_CUBIC)

    def place(p: np.ndarray) -> np.ndarray:
        return np.rint((np.asarray(p).reshape(-1, 2) - low) * scale - 0.5).astype(int)

    return np.ascontiguousarray(faded(canvas, fade)), place, scale


def _dots(canvas: np.ndarray, places: np.ndarray, size: int, color: Sequence[int]) -> None:
    for x, y in places.tolist():
        cv2.circle(canvas, (x, y), size, tuple(color), -1, cv2.LINE_AA)


def _seed_row(surface: SurfaceMatches, seed: int) -> int:
    """Row of the grid in which a seed lies."""
    cells = np.flatnonzero(surface.region == seed)
    if len(cells) == 0:
        return -1
    away = np.linalg.norm(surface.grid.pixels[cells] - surface.seeds.pixels[seed], axis=1)
    return int(surface.grid.row[cells[away.argmin()]])


def _captioned(picture: np.ndarray, words: Sequence[tuple[str, Sequence[int]]]) -> np.ndarray:
    """Put a line of coloured words below a picture."""
    d = DENSITY
    canvas = np.full((picture.shape[0] + 24 * d, picture.shape[1], 3), 255, np.uint8)
    canvas[: picture.shape[0]] = on_paper(picture)
    x = 6.0 * d
    for text, color in words:
        if text:
            canvas = write_on(canvas, text, (x, picture.shape[0] + 5 * d), 12 * d, color, bold=True)
            x += text_width(text, 12 * d, bold=True) + 12 * d
    return canvas
