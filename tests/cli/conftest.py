"""A small capture of the built-in figure, made once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from data_tools.figure import figure
from data_tools.synthesize import SynthesisSettings, synthesize
from tests.conftest import Finished

FRAMES, CAMERAS = 6, 4
SETTINGS = ["--carving.resolution", "64"]
QUICK = [*SETTINGS, "--nodes.nodes", "240", "--tracking.n_patches", "400"]  # of whole runs


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


def last_line(result: Finished) -> str:
    """What the user is told: the one line after the progress bars."""
    return [line for line in result.stderr.splitlines() if line.startswith("geomocap: ")][-1]
