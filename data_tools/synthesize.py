"""Synthetic multi-camera captures with ground truth, from an animated asset."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import Field

from data_tools.asset import AnimatedAsset
from data_tools.bar import BarRecording, record_bar
from data_tools.camera_views import DistortedView
from data_tools.image_rendering import FloorShadow, PosedSubject, Stage, compose, expose, render_subject
from data_tools.placement import make_camera, outline, place_cameras
from data_tools.room import Light, Room
from data_tools.shading import ShadedSurface
from data_tools.video_writing import VideoFile
from geomocap.errors import CaptureError
from geomocap.files.atomic import write_atomic
from geomocap.files.capture import CaptureInfo, write_capture_info
from geomocap.files.images import MOST_SIDE, write_image
from geomocap.files.rigs import write_rig
from geomocap.model.rig import Rig
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items, threads
from geomocap.settings import LEAST_FPS, MOST_FPS, Settings


class SynthesisSettings(Settings):
    """How a synthetic capture is made."""

    cameras: int = Field(8, ge=1, le=1000, description="number of cameras")
    width: int = Field(640, ge=16, le=MOST_SIDE, description="image width (pixels)")
    height: int = Field(480, ge=16, le=MOST_SIDE, description="image height (pixels)")
    fps: float = Field(30.0, ge=LEAST_FPS, le=MOST_FPS, description="frames per second")
    frames: int = Field(60, ge=1, le=999_999, description="number of frames")
    start: float = Field(0.0, ge=0, description="time in the clip at which the capture begins (s)")
    wander: float = Field(
        0.0, ge=0, description="how far the subject's place drifts, so that a looped clip never repeats a frame (m)"
    )
    subject_height: float | None = Field(
        None, gt=0, description="height of the subject at the clip's begin (m); the file's own if not given"
    )
    arc_deg: float = Field(360.0, gt=0, le=360, description="arc that the cameras stand on (degrees)")
    hfov_deg: float = Field(45.0, gt=5, lt=120, description="angle of view along the longer image side (degrees)")
    camera_height: float | None = Field(
        None, gt=0, description="height of the cameras (m); alternately 0.6 and 1.4 of the subject's if not given"
    )
    camera_distance: float | None = Field(
        None, gt=0, description="distance from the subject's middle (m); as near as shows the whole motion if not given"
    )
    fill: float = Field(0.92, gt=0.05, le=1, description="fraction of the image within which the motion stays")
    distortion: float = Field(1.0, ge=0, le=3, description="strength of lens distortion; 0: none, 1: mild (k1 ≈ −0.1)")
    noise: float = Field(1.5, ge=0, description="sensor noise, standard deviation (grey levels)")
    exposure: float = Field(0.03, ge=0, lt=1, description="greatest difference of a camera's exposure (fraction)")
    light_drift: float = Field(0.0, ge=0, lt=1, description="slow change of the light over the capture (fraction)")
    shadow: bool = Field(True, description="the subject throws a soft shadow on the floor")
    texture_contrast: float = Field(
        0.28, ge=0, le=1, description="standard deviation of the fabric relative to the subject's brightness"
    )
    bar: int = Field(0, ge=0, description="number of positions of a reference-bar recording; 0: none")
    bar_length: float | None = Field(
        None,
        gt=0,
        description="distance of the bar's targets (m); a third of the volume's longest side if not given",
    )
    withhold_calibration: bool = Field(False, description="write no sparse/ into the capture (the truth has it)")
    video: bool = Field(False, description="write `videos/<camera>.mp4` (H.264, lossy) instead of PNG images")
    seed: int = Field(0, ge=0, description="seed of everything random")


@dataclass(frozen=True)
class SynthesisResult:
    """What was made.

    Attributes
    ----------
    rig : Rig
    footprint : float
        Mean size of a pixel on the subject, metres.
    times : (T,) float
        Times in the clip, seconds, not folded.
    notes : tuple of str
        What the user should know, e.g. that the clip was looped.
    """

    rig: Rig
    footprint: float
    times: np.ndarray
    notes: tuple[str, ...]


def synthesize(
    asset: AnimatedAsset,
    capture: Path,
    truth: Path,
    settings: SynthesisSettings | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> SynthesisResult:
    """Render an animated subject in a room with several cameras, into a capture folder and a truth folder.

    A clip shorter than `frames / fps` is played in a loop. Bit for bit the same for the same asset and settings,
    whatever the number of threads.

    Parameters
    ----------
    asset : AnimatedAsset
        From `data_tools.gltf_reader.load_gltf` or `data_tools.figure`.
    capture, truth : Path
        Folders to write; neither may hold a capture already.
    executor : Executor, optional
        Threads to share the frames; one a core if not given.

    Raises
    ------
    CaptureError
        If the capture folder holds images or videos already.
    """
    settings = settings or SynthesisSettings()
    for folder in ("images", "videos"):
        if (capture / folder).exists():
            raise CaptureError(f"{capture}: holds {folder} already; remove it or choose another folder")
    asset = replace(asset.standing(settings.subject_height), wander=settings.wander)
    times = settings.start + np.arange(settings.frames) / settings.fps
    notes = []
    if asset.duration <= 0:
        notes.append(f"{asset.name} has no animation: all frames show its rest pose")
    elif times[-1] > asset.duration + 1e-6:
        notes.append(
            f"the clip lasts {asset.duration:.2f} s, {settings.frames} frames at {settings.fps:g} fps "
            f"take {settings.frames / settings.fps:.2f} s: it is played in a loop"
        )
    vertices = np.array([asset.vertices(t) for t in times])
    world = make_world(vertices, settings)
    surface = ShadedSurface.of(asset, world.footprint, settings.texture_contrast, settings.seed)

    if executor is None:
        with threads() as own:
            _record(asset, vertices, times, world, surface, capture, truth, settings, own, progress)
    else:
        _record(asset, vertices, times, world, surface, capture, truth, settings, executor, progress)
    write_truth(asset, times, vertices, settings, truth)
    write_rig(truth / "sparse", world.rig)
    if not settings.withhold_calibration:
        write_rig(capture / "sparse", world.rig)
    # The description comes last: a capture that was not finished does not open
    write_capture_info(capture, CaptureInfo(name=asset.name, fps=settings.fps, up="z", cameras=world.rig.names))
    return SynthesisResult(world.rig, world.footprint, times, tuple(notes))


@dataclass(frozen=True)
class World:
    """What stands still during a synthetic capture.

    Attributes
    ----------
    rig : Rig
    low, high : (3,) float
        Corners of the volume that the motion fills, metres.
    room : Room
    light : Light
    gains : (C,) float
        Exposures of the cameras.
    footprint : float
        Mean size of a pixel on the subject, metres.
    """

    rig: Rig
    low: np.ndarray
    high: np.ndarray
    room: Room
    light: Light
    gains: np.ndarray
    footprint: float


def make_world(vertices: np.ndarray, settings: SynthesisSettings) -> World:
    """Place cameras, room and lights for a motion: vertices (T, V, 3), metres."""
    random = np.random.default_rng((settings.seed, 1))
    points = outline(vertices.reshape(-1, 3))
    cameras = [
        make_camera(settings.width, settings.height, settings.hfov_deg, settings.distortion, random)
        for _ in range(settings.cameras)
    ]
    rig = place_cameras(
        cameras, points, settings.arc_deg, settings.camera_height, settings.camera_distance, settings.fill
    )
    low, high = points.min(axis=0), points.max(axis=0)
    everything = np.concatenate([rig.centers, points])
    margin = 0.3 * float((high - low).max())
    middle = (low + high) / 2
    half = float(np.abs(everything - middle)[:, :2].max()) + margin
    room_low = np.array([middle[0] - half, middle[1] - half, 0.0])
    room_high = np.array([middle[0] + half, middle[1] + half, everything[:, 2].max() + margin])
    depth = np.einsum("ci,ci->c", middle - rig.centers, rig.viewing_directions)
    focal = np.array([c.mean_focal_length() for c in rig.cameras])
    return World(
        rig=rig,
        low=low,
        high=high,
        room=Room(room_low, room_high, settings.seed),
        light=Light.studio(),
        gains=1 + settings.exposure * random.uniform(-1, 1, len(rig)),
        footprint=float(np.mean(depth / focal)),
    )


def _record(
    asset: AnimatedAsset,
    vertices: np.ndarray,
    times: np.ndarray,
    world: World,
    surface: ShadedSurface,
    capture: Path,
    truth: Path,
    settings: SynthesisSettings,
    executor: Executor,
    progress: Progress,
) -> None:
    rig, light, seed = world.rig, world.light, settings.seed
    drift = 1 + settings.light_drift * np.sin(2 * np.pi * np.arange(len(times)) / max(len(times), 1) * 0.7)

    # Empty room: rendered once a camera, and photographed once
    def make_stage(c: int) -> Stage:
        view = DistortedView.of(rig, c)
        stage = Stage(view, world.room.render(view, light), world.room.floor_positions(view))
        plate = expose(stage.background, world.gains[c], settings.noise, (seed, 2, c))
        write_png(capture / "background" / f"{rig.names[c]}.png", plate)
        return stage

    stages = list(map_items(make_stage, range(len(rig)), executor, "room", progress))

    # Subject: one ray casting scene a frame, seen by all cameras
    def make_frame(t: int) -> list[np.ndarray]:
        subject = PosedSubject.of(surface, vertices[t])
        shadow = FloorShadow.cast(subject, light) if settings.shadow else None
        pictures = []
        for c, (name, stage) in enumerate(zip(rig.names, stages, strict=True)):
            pixels, coverage, colors = render_subject(subject, surface, rig, c, stage.view, light)
            image = compose(stage, light, shadow, pixels, coverage, colors)
            picture = expose(image, world.gains[c] * drift[t], settings.noise, (seed, 3, c, t))
            mask = np.zeros((settings.height, settings.width), dtype=np.uint8)
            mask.ravel()[pixels[coverage >= 0.5]] = 255
            write_png(truth / "masks" / name / f"{t:06d}.png", mask)
            if settings.video:
                pictures.append(picture)
            else:
                write_png(capture / "images" / name / f"{t:06d}.png", picture)
        return pictures

    frames = map_items(make_frame, range(len(times)), executor, "frames", progress, ahead=4)
    if settings.video:
        _write_videos(frames, capture, rig.names, settings)
    else:
        for _ in frames:
            pass

    if settings.bar:
        bar = BarRecording.plan(rig, world.low, world.high, settings.bar, settings.bar_length, world.footprint, seed)
        record_bar(bar, rig, stages, world.gains, settings.noise, capture, truth, seed, executor, progress)


def _write_videos(
    frames: Iterator[list[np.ndarray]], capture: Path, names: tuple[str, ...], settings: SynthesisSettings
) -> None:
    files = [VideoFile(capture / "videos" / f"{n}.mp4", settings.width, settings.height, settings.fps) for n in names]
    try:
        for pictures in frames:
            for file, picture in zip(files, pictures, strict=True):
                file.add(picture)
        for file in files:
            file.finish()
    finally:
        for file in files:
            file.close()


def write_truth(
    asset: AnimatedAsset, times: np.ndarray, vertices: np.ndarray, settings: SynthesisSettings, truth: Path
) -> None:
    """Write truth.npz: the surface, the joints and what moves what."""
    joints = [asset.joint_transforms(t) for t in times]
    weights = asset.vertex_weights
    content = {
        "fps": np.float64(settings.fps),
        "vertices": vertices.astype(np.float32),
        "faces": asset.faces.astype(np.int32),
        "vertex_joint": weights.argmax(axis=1).astype(np.int32),
        "vertex_weights": weights.astype(np.float32),
        "joint_names": np.array(asset.joint_names),
        "joint_parents": asset.joint_parents.astype(np.int32),
        "joint_positions": np.array([p for p, _ in joints]),
        "joint_rotations": np.array([r for _, r in joints]),
        **asset.truth_extras,
    }
    write_atomic(truth / "truth.npz", lambda p: np.savez_compressed(p, **content))


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) grey, uint8, with OpenCV's fast default compression."""
    write_image(path, image)
