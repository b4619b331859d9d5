"""The smallest capture that goes all the way, and its run, for what is done hundreds of times."""

from __future__ import annotations

import hashlib
import io
import json
import os
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TextIO
from unittest.mock import patch

from data_tools.figure import figure
from data_tools.synthesize import SynthesisSettings, synthesize

QUICK = [
    *("--carving.resolution", "32", "--refinement.rounds", "0", "--motion_bodies.depth_rounds", "0"),
    *("--no-pictures", "--workers", "1"),
]
VARIANTS: dict[str, tuple[str, ...]] = {
    "voxels": (),
    "cloud": ("--source", "cloud"),
    "report": ("--pictures",),
    "windows": ("--windows.frames", "12", "--windows.overlap", "3", "--tracking.n_patches", "150"),
}
CHANGING = {"timings.json", "run.toml", "timings.png", "report.html"}  # with how long it took


def make_tiny(folder: Path, variant: str = "voxels") -> Path:
    """Synthesize a capture of three frames: four cameras, 96×72; for clouds, which are matched, twelve of 128×96.

    For windows it has 26 frames.
    """
    cameras, width, height = (12, 128, 96) if variant == "cloud" else (4, 96, 72)
    frames, fps = (26, 30) if variant == "windows" else (3, 10)
    settings = SynthesisSettings(cameras=cameras, width=width, height=height, fps=fps, frames=frames)
    synthesize(figure(), folder / "capture", folder / "truth", settings)
    return folder / "capture"


def run_tiny(capture: Path, run: Path, *more: str) -> tuple[object, str]:
    """Make a tiny run in this process; return its exit status and what it told."""
    return command("run", str(capture), str(run), *QUICK, *more)


def command(*arguments: str) -> tuple[object, str]:
    """Run the command line in this process; return its exit status and what it told."""
    from geomocap.cli import main

    told = io.StringIO()
    with patch.object(sys, "argv", ["geomocap", *arguments]):
        with redirect_stderr(told), redirect_stdout(told):
            try:
                main()
            except SystemExit as end:
                return end.code or 0, told.getvalue()
    return 0, told.getvalue()


def digests(run: Path) -> dict[str, str]:
    """Digest of every result file; the records of when and how long are left out."""
    return {
        str(p.relative_to(run)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(run.rglob("*"))
        if p.is_file() and p.name not in CHANGING and ".stages" not in p.parts
    }


def cut(run: Path) -> list[str]:
    """Name the records of when and how long, whose digests say nothing, that are there but not whole."""
    found = []
    for path in sorted(p for p in run.rglob("*") if p.name in CHANGING and ".stages" not in p.parts):
        data = path.read_bytes()
        try:
            match path.suffix:
                case ".json":
                    whole = bool(json.loads(data))
                case ".toml":
                    whole = "source" in tomllib.loads(data.decode())
                case ".png":
                    whole = data.endswith(b"IEND\xaeB`\x82")
                case _:
                    whole = data.rstrip().endswith(b"</html>")
        except ValueError:
            whole = False
        if not whole:
            found.append(str(path.relative_to(run)))
    return found


@contextmanager
def quiet() -> Iterator[TextIO]:
    """Keep what libraries print from being seen; yield where to print instead."""
    with os.fdopen(os.dup(1), "w") as told, open(os.devnull, "w") as nowhere:
        for stream in (1, 2):  # Open3D's surface reconstruction talks
            os.dup2(nowhere.fileno(), stream)
        yield told
