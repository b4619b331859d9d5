"""The report: one self-contained HTML page of sections, each a list of blocks."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

import jinja2
import numpy as np
from PIL import Image

from geomocap.files.atomic import write_text
from viz.drawing import DENSITY, webp
from viz.turntable import Turntable

_HOW_TO_TURN = (
    "Drag to turn, click and scroll or pinch to come nearer, right-drag to shift; space plays, the arrow keys go on by "
    "single frames. Point at a body or joint to read its name, its angles with their band, and its confidence; click "
    "it to keep that in view."
)
EMBEDDED_VIDEO = 6_000_000
"""Videos up to this many bytes go into the page; larger ones are linked beside it."""

LARGE_PLOT = 120_000
"""Plots whose PNG has more bytes are embedded with a small loss: four of a demo in 0.3 s, not 1.9 s, and 0.6 MB."""


@dataclass(frozen=True)
class Block:
    """A piece of a section: text, a picture, a table and so on, as `kind` says."""

    kind: Literal["text", "missing", "heading", "fine", "warnings", "picture", "turntable", "video", "table", "code"]
    text: str = ""
    title: str = ""
    source: str = ""
    width: int = 0
    height: int = 0
    look: Literal["sheet", "plot"] = "sheet"
    folded: bool = False
    items: tuple[str, ...] = ()
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    numbers: tuple[int, ...] = ()
    colors: tuple[str, ...] = ()


@dataclass(frozen=True)
class Section:
    """A titled part of the report, with an anchor for the table of contents."""

    title: str
    anchor: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Report:
    """A whole report."""

    title: str
    lead: str
    key_figures: tuple[tuple[str, str], ...] = ()
    sections: tuple[Section, ...] = ()
    turntable: Turntable | None = None
    footer: str = field(default="Made by geomocap.")


def text(words: str) -> Block:
    """Return a paragraph."""
    return Block("text", words)


def missing(words: str) -> Block:
    """Return a sentence about what isn't there."""
    return Block("missing", words)


def picture(image: np.ndarray, title: str, words: str) -> Block:
    """Return an image (H, W, 3) uint8 with a caption, embedded as WebP, `DENSITY` of its pixels a pixel of the page."""
    height, width = (round(n / DENSITY) for n in image.shape[:2])
    return Block("picture", words, title, _data_uri("image/webp", webp(image)), width, height)


def plot(png: bytes, title: str, words: str) -> Block:
    """Return a plot with a caption, embedded as WebP, without loss if it is small."""
    with Image.open(io.BytesIO(png)) as drawn:
        image = drawn.convert("RGB")
    width, height = image.size
    data = webp(np.asarray(image), 82) if len(png) > LARGE_PLOT else _exact(image)
    source = _data_uri("image/webp", data)
    return Block("picture", words, title, source, round(width / DENSITY), round(height / DENSITY), look="plot")


def _exact(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", lossless=True, quality=40, method=2)
    return buffer.getvalue()


def turning(still: np.ndarray | None, title: str) -> Block:
    """Return the place of the report's turntable, with a picture for browsers that can't draw it."""
    return Block("turntable", _HOW_TO_TURN, title, "" if still is None else _data_uri("image/webp", webp(still)))


def video(file: Path, title: str, words: str, folded: bool = False) -> Block:
    """Return a video with a caption: embedded if it is small, otherwise linked by its name beside the page.

    Folded, a line stands for it until the reader opens it.
    """
    small = file.stat().st_size <= EMBEDDED_VIDEO
    source = _data_uri("video/mp4", file.read_bytes()) if small else file.name
    return Block("video", words, title, source, folded=folded)


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = (), colors: Sequence[str] = ()
) -> Block:
    """Return a table; `numbers` are the columns set flush right, `colors` swatches before the rows' first cells."""
    return Block(
        "table", head=tuple(head), rows=tuple(tuple(r) for r in rows), numbers=tuple(numbers), colors=tuple(colors)
    )


@cache
def _page_part(name: str) -> str:
    """Text of a file beside the template, as it goes into every page."""
    return (Path(__file__).parent / "templates" / name).read_text(encoding="utf-8")


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("viz"), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    return environment.get_template("report.html")


def render_html(report: Report) -> str:
    """Return the page's HTML."""
    return _template().render(
        title=report.title,
        lead=report.lead,
        key_figures=report.key_figures,
        sections=[s for s in report.sections if s.blocks],
        footer=report.footer,
        turntable=report.turntable,
        three=_page_part("three.min.js") if report.turntable else "",
        script=_page_part("turntable.js") if report.turntable else "",
        licence=_page_part("three.LICENSE.txt") if report.turntable else "",
    )


def write_report(path: Path, report: Report) -> None:
    """Write the page, whole or not at all.

    Raises
    ------
    RunError
        If it can't be written.
    """
    write_text(path, render_html(report))
