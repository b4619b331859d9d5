"""Synthetic captures as a whole, and a picture of the subject beside casting rays through every pixel."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from data_tools.camera_views import DistortedView
from data_tools.figure import figure
from data_tools.image_rendering import PosedSubject, expose, render_subject
from data_tools.shading import ShadedSurface
from data_tools.synthesize import SynthesisSettings, make_world, synthesize
from tests.benchmarks.table import Row, measure

FRAMES = 8


def benchmark() -> list[Row]:
    """Measure a capture as a whole, and one picture of the subject against casting its rays through all pixels."""
    asset = figure()
    settings = SynthesisSettings(frames=FRAMES)
    vertices = np.array([asset.vertices(t) for t in np.arange(FRAMES) / settings.fps])
    world = make_world(vertices, settings)
    surface = ShadedSurface.of(asset, world.footprint, settings.texture_contrast, 0)
    subject, view = PosedSubject.of(surface, vertices[0]), DistortedView.of(world.rig, 0)
    everywhere = np.arange(settings.width * settings.height)
    light = np.full((settings.height, settings.width, 3), 100, np.float32)

    def picture() -> None:
        render_subject(subject, surface, world.rig, 0, view, world.light)

    def all_pixels() -> None:
        subject.scene.cast(view.rays(everywhere, 2).reshape(-1, 6))

    once, frame = min((_capture(settings) for _ in range(2)), key=sum)
    return [
        Row(
            "synthetic capture, 8 cameras 640×480, 60 frames with PNGs, masks and truth",
            once + 60 * frame,
            goal="about a minute",
            note=f"{once:.1f} s once and {frame:.2f} s a frame, from {FRAMES} frames",
        ),
        Row(
            "subject in one 640×480 picture, rays and shading",
            measure(picture),
            "Open3D cast_rays, 4 rays at every pixel, no shading",
            measure(all_pixels),
        ),
        Row(
            "exposure and noise of one 640×480 picture",
            measure(lambda: expose(light, 1.0, settings.noise, (0, 1))),
        ),
    ]


def _capture(settings: SynthesisSettings) -> tuple[float, float]:
    """Seconds that a capture takes once, and for each frame of all cameras."""
    folder = Path(tempfile.mkdtemp())
    times: dict[tuple[str, int], float] = {}

    def note(stage: str, done: int, total: int) -> None:
        times[stage, done] = time.perf_counter()

    start = time.perf_counter()
    try:
        synthesize(figure(), folder / "capture", folder / "truth", settings, progress=note)
        total = time.perf_counter() - start
    finally:
        shutil.rmtree(folder)
    frames = times["frames", settings.frames] - times["frames", 0]
    return total - frames, frames / settings.frames
