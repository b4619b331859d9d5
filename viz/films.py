"""Videos that browsers play: H.264, yuv420p, index first."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from threading import Event

import av
import cv2
import numpy as np

from geomocap.errors import RunError
from geomocap.files.atomic import write_atomic
from geomocap.files.whole_files import is_whole_mp4
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items, threads
from viz import scene
from viz.desk import REPORTED
from viz.drawing import GAP, fit, on_paper, write_on
from viz.rendering import Look, Model
from viz.run_contents import Results
from viz.sheets import overlay, picture, tile_size
from viz.viewpoints import ViewStage

SMOOTH_FPS = 30.0
"""Frames a second that look smooth: films are seldom made with more."""


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float, quality: int = 23) -> None:
    """Write frames, (H, W, 3) uint8 RGB all of one size, as MP4, whole or not at all.

    Odd sizes get a white border on the right and below. `quality` is x264's constant rate factor: less is better.

    Raises
    ------
    RunError
        If there are no frames, or the file can't be written.
    """

    def write(target: Path) -> None:
        container = None
        stream: av.VideoStream | None = None
        try:
            for frame in frames:
                height, width = (n + n % 2 for n in frame.shape[:2])
                if container is None or stream is None:
                    container = av.open(str(target), "w", format="mp4", options={"movflags": "+faststart"})
                    stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                    # Macroblock trees make x264's output depend on what the memory held before; so do threads.
                    stream.options = {"crf": str(quality), "preset": "medium", "x264-params": "mbtree=0"}
                    stream.codec_context.thread_count = 1
                if (height, width) != frame.shape[:2]:
                    padding = ((0, height - frame.shape[0]), (0, width - frame.shape[1]), (0, 0))
                    frame = np.pad(frame, padding, constant_values=255)
                rgb = np.ascontiguousarray(frame)
                planes = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420), np.uint8)  # repeats, unlike swscale
                container.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format="yuv420p")))
            if container is None or stream is None:
                raise RunError(f"{path}: no frames for a video")
            container.mux(stream.encode())
        finally:
            if container is not None:
                container.close()

    write_atomic(path, write, is_whole_mp4)


def best_camera(results: Results, stage: ViewStage) -> str | None:
    """Return the camera that sees the broad side of the subject best; None without a calibrated capture."""
    capture = results.capture
    if capture is None or not capture.is_calibrated:
        return None
    rig = capture.rig
    side = np.abs(rig.viewing_directions @ np.cross(stage.broad, stage.up))
    pixels = rig.project(stage.points + stage.centers[len(stage.centers) // 2])
    inside = [np.mean(((p > 0) & (p < s)).all(axis=1)) for p, s in zip(pixels, rig.sizes, strict=True)]
    return rig.names[int(np.argmax(side * np.array(inside)))]


def thinning(frames: int, fps: float, at_most: int) -> int:
    """Return how many frames of a recording a film goes on by: it has few enough, and about `SMOOTH_FPS` at most."""
    return max(1, -(-frames // at_most), round(fps / SMOOTH_FPS))


def motion_video(
    results: Results,
    stage: ViewStage,
    path: Path,
    at_most: int = 100,
    progress: Progress = silent,
    turn_deg: float = 60.0,
    look: Look | None = None,
) -> None:
    """Write the motion as a video: the bodies and the skeleton from a slowly turning view, and over a camera's image.

    Parameters
    ----------
    results : Results
    stage : ViewStage
    path : Path
        An MP4 file.
    at_most : int
        Longer sequences are thinned out, and the frame rate with them; so are faster ones, to about `SMOOTH_FPS`.
    progress : Progress
    turn_deg : float
        How far the free view turns over the video, degrees.
    look : Look, optional

    Raises
    ------
    RunError
        If there are no frames or the file can't be written.
    """
    look = look or Look()
    rate = results.fps or 15.0
    step = thinning(len(results.frames), rate, at_most)
    frames = results.frames[::step]
    fps = max(1.0, rate / step)
    camera = best_camera(results, stage)
    size = tile_size(stage, 0, 12, 95_000)
    size = (max(size[0], 240), size[1])
    everywhere = (stage.points[::8] + stage.centers[:: max(1, len(stage.centers) // 16), None]).reshape(-1, 3)
    show_bodies = "bodies" in results.kinds or results.skeleton is None or not results.skeleton.bones

    def draw(job: tuple[int, int]) -> np.ndarray:
        i, frame = job
        azimuth = turn_deg * (i / max(len(frames) - 1, 1) - 0.5)
        view = stage.view(azimuth, 12.0, size)
        skin = scene.rough_skin(results, frame, 90)
        bones = scene.skeleton(results, frame, stage.diagonal)
        panels, solid = [], Model([skin])
        if show_bodies:
            panels.append(on_paper(picture(results, stage, solid, view, frame, look)))
        model = Model([scene.glass(skin), *bones], like=solid) if bones else solid
        if bones:
            panels.append(on_paper(picture(results, stage, model, view, frame, look)))
        if camera is not None:
            drawn = overlay(results, camera, frame, model, 520, 1.0 if bones else 0.7, look, everywhere)
            panels.append(fit(drawn, (round(size[1] * drawn.shape[1] / drawn.shape[0]), size[1])))
        gap = np.full((size[1], GAP, 3), 255, np.uint8)
        image = np.concatenate([p for panel in panels for p in (panel, gap)][:-1], axis=1)
        return write_on(image, f"frame {frame}", (8, size[1] - 8), 12, (118, 124, 133), anchor="lb")

    with threads() as executor:
        drawn = map_items(draw, list(enumerate(frames)), executor, "video", progress, ahead=6)
        write_video(path, drawn, fps)


@contextmanager
def filmed_beside(
    results: Results, stage: ViewStage | None, path: Path, progress: Progress = silent, look: Look | None = None
) -> Iterator[Callable[[], Path | None]]:
    """Make the film beside other work of the block, most of which keeps one core busy; see `motion_video`.

    Gives a function that waits for the film, reports how far it is, and returns its path; None: there is nothing to
    film. If the block ends earlier, the film is given up.
    """
    if stage is None or len(results.frames) < 2:
        yield lambda: None
        return
    left = Event()
    reached: deque[tuple[str, int, int]] = deque(maxlen=1)

    def report(name: str, done: int, total: int) -> None:
        if left.is_set():
            raise RunError(f"{path}: given up")
        reached.append((name, done, total))

    with ThreadPoolExecutor(1) as beside:
        film = beside.submit(motion_video, results, stage, path, progress=report, look=look)

        def finished() -> Path:
            done = False
            while not done:  # progress is reported by the thread that began the work
                done = bool(wait([film], REPORTED).done)
                for last in tuple(reached):
                    progress(*last)
            film.result()
            return path

        try:
            yield finished
        finally:
            left.set()
