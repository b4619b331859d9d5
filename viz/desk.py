"""Where the files of a review are written, and how far it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geomocap.files.atomic import write_bytes
from geomocap.progress import Progress
from viz.drawing import write_png
from viz.report import Block, picture, plot


@dataclass
class Desk:
    """What is being written: files in RUN/review, and their progress.

    `story` holds a row of pictures of each stage of the work, one for each frame, all seen from the same place.
    """

    folder: Path
    progress: Progress
    total: int
    written: list[Path] = field(default_factory=list)
    done: int = 0
    story: list[tuple[str, list[np.ndarray]]] = field(default_factory=list)

    def step(self) -> None:
        """Report one more part as done."""
        self.done += 1
        self.progress("review", min(self.done, self.total), self.total)

    def sheet(self, name: str, image: np.ndarray | None, heading: str, words: str) -> list[Block]:
        """Write a picture as PNG and return its block; nothing if there is no picture."""
        self.step()
        if image is None:
            return []
        path = self.folder / f"{name}.png"
        write_png(path, image)
        self.written.append(path)
        return [picture(image, heading, words)]

    def plot(self, name: str, png: bytes, heading: str, words: str) -> list[Block]:
        """Write a plot and return its block."""
        self.step()
        path = self.folder / f"{name}.png"
        write_bytes(path, png)
        self.written.append(path)
        return [plot(png, heading, words)]
