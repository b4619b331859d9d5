"""Words and lines on pictures, and pictures put together."""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from geomocap.files.atomic import write_bytes
from viz.body_colors import INK

FAINT = (118, 124, 133)
"""Secondary text, RGB 0–255."""

DENSITY = 2
"""Pixels of a picture along a pixel of the page that shows it."""

FRAME = (168, 174, 182)
"""Fine line around pictures, RGB 0–255."""

GAP = 8
"""Pixels of the page between the pictures of a sheet."""


@cache
def _font(size: int, bold: bool) -> ImageFont.FreeTypeFont:
    """Return a font that comes with Matplotlib, so that it is the same everywhere."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def write_on(
    image: np.ndarray,
    text: str,
    position: tuple[float, float],
    size: int = 13,
    color: Sequence[int] = INK,
    bold: bool = False,
    anchor: str = "lt",
    plate: Sequence[int] | None = None,
) -> np.ndarray:
    """Return an image with a line of text.

    Parameters
    ----------
    image : (H, W, 3) or (H, W, 4) uint8
    text : str
    position : (float, float)
        Where the anchor stands: x, y in pixels.
    size : int
        Height of the letters' em, pixels.
    color : RGB
    bold : bool
    anchor : str
        Pillow's anchor, "lt": left top.
    plate : RGB, optional
        Colour of a plate behind the text.
    """
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    font = _font(size, bold)
    if plate is not None:
        left, top, right, bottom = draw.textbbox(position, text, font=font, anchor=anchor)
        pad = max(2, size // 4)
        draw.rounded_rectangle((left - pad, top - pad, right + pad, bottom + pad), pad, fill=tuple(plate))
    draw.text(position, text, font=font, fill=tuple(color), anchor=anchor)
    return np.asarray(picture).copy()


def text_width(text: str, size: int = 13, bold: bool = False) -> int:
    """Return the width of a line of text, pixels."""
    return int(np.ceil(_font(size, bold).getlength(text)))


def fit(image: np.ndarray, size: tuple[int, int], fill: Sequence[int] = (255, 255, 255)) -> np.ndarray:
    """Return an image scaled to fit into `size` (width, height), centred on `fill`."""
    width, height = size
    scale = min(width / image.shape[1], height / image.shape[0])
    w, h = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    small = resize(image, (w, h))
    canvas = np.full((height, width, 3), fill, np.uint8)
    x, y = (width - w) // 2, (height - h) // 2
    canvas[y : y + h, x : x + w] = small
    return canvas


def resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return an image at another size (width, height): averaged when it shrinks, smooth when it grows."""
    if (image.shape[1], image.shape[0]) == tuple(size):
        return image
    shrinks = size[0] < image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def faded(image: np.ndarray, strength: float = 0.45) -> np.ndarray:
    """Return a photograph made paler and less colourful, so that what is drawn over it stands out."""
    gray = image.astype(np.float32).mean(axis=2, keepdims=True)
    soft = 0.5 * image + 0.5 * gray
    return np.clip(soft + strength * (255 - soft), 0, 255).astype(np.uint8)


def outlined(image: np.ndarray, mask: np.ndarray, color: Sequence[int], fill: float = 0.18) -> np.ndarray:
    """Return an image with a silhouette drawn over it: a line along its border and a tint inside.

    Parameters
    ----------
    image : (H, W, 3) uint8
    mask : (h, w) uint8
        Non-zero inside; scaled to the image's size.
    color : RGB
    fill : float
        Opacity of the tint.
    """
    height, width = image.shape[:2]
    scale = 3
    large = cv2.resize(mask, (width * scale, height * scale), interpolation=cv2.INTER_NEAREST)
    inside = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA)[..., None] / 255.0
    contours, _ = cv2.findContours(large, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    line = np.zeros_like(large)
    cv2.drawContours(line, contours, -1, 255, scale, cv2.LINE_AA)
    border = cv2.resize(line, (width, height), interpolation=cv2.INTER_AREA)[..., None] / 255.0
    opacity = np.maximum(fill * inside, np.minimum(border * 1.3, 1.0))
    return np.clip(image * (1 - opacity) + np.asarray(color, float) * opacity, 0, 255).astype(np.uint8)


def sheet(
    rows: Sequence[Sequence[np.ndarray | None]],
    row_labels: Sequence[str] = (),
    column_labels: Sequence[str] = (),
    framed: bool = False,
) -> np.ndarray:
    """Return a grid of pictures with labels on top of the columns and at the left of the rows.

    Parameters
    ----------
    rows : sequence of sequences of (H, W, 3) or (H, W, 4) uint8 or None
        Pictures may differ in size; each is centred in its cell.
    row_labels, column_labels : sequence of str
    framed : bool
        Draw a fine line around each picture.

    Returns
    -------
    (H, W, 4) uint8
        RGB and opacity: what is around the pictures is clear, so that the sheet suits any page.
    """
    gap, letters = GAP * DENSITY, 13 * DENSITY
    n_columns = max(len(r) for r in rows)
    columns = [[r[c] for r in rows if c < len(r)] for c in range(n_columns)]
    widths = [max((p.shape[1] for p in column if p is not None), default=0) for column in columns]
    heights = [max((p.shape[0] for p in r if p is not None), default=0) for r in rows]
    label_width = max((text_width(t, letters) for t in row_labels), default=0) + (14 * DENSITY if row_labels else 0)
    label_height = 26 * DENSITY if column_labels else gap
    canvas = np.empty(
        (label_height + sum(heights) + gap * len(rows), label_width + sum(widths) + gap * (n_columns + 1), 4), np.uint8
    )
    canvas[:] = (*FAINT, 0)  # words mix with the colour of what is clear, too
    y = label_height
    for r, row in enumerate(rows):
        x = label_width + gap
        for c, picture in enumerate(row):
            if picture is not None:
                h, w = picture.shape[:2]
                left, top = x + (widths[c] - w) // 2, y + (heights[r] - h) // 2
                place = canvas[top : top + h, left : left + w]
                place[..., : picture.shape[2]] = picture
                if picture.shape[2] == 3:
                    place[..., 3] = 255
                if framed:
                    cv2.rectangle(canvas, (left, top), (left + w - 1, top + h - 1), (*FRAME, 255), DENSITY)
            x += widths[c] + gap
        y += heights[r] + gap
    x = label_width + gap
    for c, label in enumerate(column_labels):
        canvas = write_on(canvas, label, (x + widths[c] / 2, label_height / 2), letters, FAINT, anchor="mm")
        x += widths[c] + gap
    y = label_height
    for r, label in enumerate(row_labels):
        canvas = write_on(canvas, label, (label_width - 6 * DENSITY, y + heights[r] / 2), letters, FAINT, anchor="rm")
        y += heights[r] + gap
    return canvas


def on_paper(image: np.ndarray) -> np.ndarray:
    """Return an image, (H, W, 3) or with opacity (H, W, 4) uint8, on white: (H, W, 3) uint8."""
    if image.shape[2] == 3:
        return image
    opacity = image[..., 3:].astype(np.uint16)
    mixed = image[..., :3] * opacity + 255 * (255 - opacity) + 128
    return ((mixed + (mixed >> 8)) >> 8).astype(np.uint8)  # exactly divided by 255 and rounded


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8 RGB as PNG, whole or not at all; one with opacity on white."""
    rows = cv2.cvtColor(on_paper(image), cv2.COLOR_RGB2BGR)
    write_bytes(path, cv2.imencode(".png", rows, [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE])[1].data)


def webp(image: np.ndarray, quality: int = 76) -> bytes:
    """Return an image (H, W, 3) uint8 RGB, or (H, W, 4) with opacity, as the bytes of a WebP picture."""
    buffer = io.BytesIO()
    # Methods above 2 take more than twice the time for 5 % less.
    Image.fromarray(image).save(buffer, "WEBP", quality=quality, alpha_quality=60, method=2)
    return buffer.getvalue()
