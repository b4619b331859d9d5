"""Where the files of a review are written, and how far it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, wait
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import TypeVar

import numpy as np

from geomocap.errors import RunError
from geomocap.files.atomic import write_bytes
from geomocap.progress import Progress
from geomocap.scheduling import threads
from viz.drawing import write_png
from viz.report import Block, picture, plot

REPORTED = 0.25
"""Seconds between two reports of what is made beside."""

Made = TypeVar("Made")


@dataclass
class Steps:
    """How many parts are done, counted by any thread; what is given up ends at its next step."""

    total: int
    done: int = 0
    given_up: bool = False
    _lock: Lock = field(default_factory=Lock)

    def step(self) -> None:
        """Count one more part as done."""
        if self.given_up:
            raise RunError("the review was given up")
        with self._lock:
            self.done += 1


@dataclass
class Desk:
    """What is being written: files in RUN/review, and their progress.

    `story` holds a row of pictures of each stage of the work, one for each frame, all seen from the same place.
    """

    folder: Path
    progress: Progress
    steps: Steps
    written: list[Path] = field(default_factory=list)
    story: list[tuple[str, list[np.ndarray]]] = field(default_factory=list)

    @classmethod
    def of(cls, folder: Path, progress: Progress, total: int) -> Desk:
        """Return a desk for so many pictures and other parts."""
        return cls(folder, progress, Steps(total))

    def report(self) -> None:
        """Tell how far it is."""
        self.progress("review", min(self.steps.done, self.steps.total), self.steps.total)

    def side_by_side(self, makers: Sequence[Callable[[Desk], Made]]) -> list[Made]:
        """Return what all make, each at a desk of its own: on all cores, and in their order, as is what they write."""
        desks = [Desk(self.folder, self.progress, self.steps) for _ in makers]
        with threads() as executor:
            pairs = list(zip(makers, desks, strict=True))
            made = [executor.submit(make, desk) for make, desk in reversed(pairs)][::-1]  # later ones take longer
            waiting = set(made)
            try:
                while waiting:
                    done, waiting = wait(waiting, REPORTED, FIRST_EXCEPTION)
                    for future in done:
                        future.result()
                    self.report()
            except BaseException:
                self.steps.given_up = True
                executor.shutdown(cancel_futures=True)
                raise
        for desk in desks:
            self.written += desk.written
            self.story += desk.story
        return [future.result() for future in made]

    def sheet(self, name: str, image: np.ndarray | None, heading: str, words: str) -> list[Block]:
        """Write a picture as PNG and return its block; nothing if there is no picture."""
        self.steps.step()
        if image is None:
            return []
        path = self.folder / f"{name}.png"
        write_png(path, image)
        self.written.append(path)
        return [picture(image, heading, words)]

    def plot(self, name: str, png: bytes, heading: str, words: str) -> list[Block]:
        """Write a plot and return its block."""
        self.steps.step()
        path = self.folder / f"{name}.png"
        write_bytes(path, png)
        self.written.append(path)
        return [plot(png, heading, words)]
