"""A small capture of the built-in figure, made once, and the command line as users call it."""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from data_tools.figure import figure
from data_tools.synthesize import SynthesisSettings, synthesize
from geomocap.cli import main

FRAMES, CAMERAS = 6, 4
SETTINGS = ["--carving.resolution", "64"]


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    settings = SynthesisSettings(cameras=CAMERAS, width=160, height=120, fps=10, frames=FRAMES)
    synthesize(figure(), folder / "capture", folder / "truth", settings)
    return folder / "capture"


@pytest.fixture
def capture(small_capture, tmp_path) -> Path:
    """A copy that a test may damage."""
    return shutil.copytree(small_capture, tmp_path / "capture")


@dataclass(frozen=True)
class Finished:
    """How a call of the command line ended."""

    returncode: int
    stderr: str


Command = Callable[..., Finished]


@pytest.fixture(scope="session")
def geomocap() -> Command:
    """Call the command line's own entry point, in this process, with its errors caught as the shell would see them."""

    def call(*arguments: object, check: bool = True) -> Finished:
        told = io.StringIO()
        status: int | str | None = 0
        with pytest.MonkeyPatch.context() as patch, redirect_stderr(told), redirect_stdout(io.StringIO()):
            patch.setattr(sys, "argv", ["geomocap", *map(str, arguments)])
            try:
                main()
            except SystemExit as end:
                status = end.code
        code = status if isinstance(status, int) else 0 if status is None else 1
        if check:
            assert code == 0, told.getvalue()
        return Finished(code, told.getvalue())

    return call


def last_line(result: Finished) -> str:
    """What the user is told: the one line after the progress bars."""
    return [line for line in result.stderr.splitlines() if line.startswith("geomocap: ")][-1]
