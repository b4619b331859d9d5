"""Captures changed: given silhouettes, time reversed, cameras that see a part, other cameras; scans of the truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from geomocap.files.capture import Capture
from geomocap.files.rigs import write_rig
from geomocap.files.scan_geometry import ScanSurface, places_on
from geomocap.model.rig import Rig

LENSES = (
    ("PINHOLE", (640, 480), []),
    ("OPENCV", (960, 720), [-0.22, 0.06, 0.001, -0.0005]),
    ("OPENCV", (640, 480), [-0.22, 0.06, 0.001, -0.0005]),
    ("SIMPLE_RADIAL", (480, 360), [-0.15]),
    ("OPENCV_FISHEYE", (640, 480), [0.02, -0.01, 0.002, 0.0]),
    ("OPENCV", (800, 600), [-0.22, 0.06, 0.001, -0.0005]),
    ("FULL_OPENCV", (640, 480), [-0.2, 0.05, 0.0005, 0.0005, 0.0, 0.0, 0.0, 0.0]),
    ("PINHOLE", (640, 480), []),
)
"""COLMAP's model, image size (pixels) and distortion of each camera."""


def give_silhouettes(grow: int) -> Callable[[Path, Path], None]:
    """Give the capture the true silhouettes, `grow` pixels too large (or, if negative, too small)."""

    def change(capture: Path, truth: Path) -> None:
        work = cv2.dilate if grow > 0 else cv2.erode
        for file in sorted((truth / "masks").rglob("*.png")):
            mask = work(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.ones((3, 3), np.uint8), iterations=abs(grow))
            target = capture / file.relative_to(truth)
            target.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(target), mask)

    return change


def reverse(capture: Path, truth: Path) -> None:
    """Let capture and truth run backwards."""
    for folder in (*(capture / "images").iterdir(), *(truth / "masks").iterdir()):
        files = sorted(folder.glob("*.png"))
        kept = [f.rename(f.with_suffix(".kept")) for f in files]
        for file, old in zip(files, reversed(kept), strict=True):
            old.rename(file)
    with np.load(truth / "truth.npz") as loaded:
        arrays = dict(loaded)
    T = len(arrays["vertices"])
    moving = ("vertices", "joint_positions", "joint_rotations")
    assert all(len(arrays[name]) == T for name in moving)
    np.savez_compressed(truth / "truth.npz", **{k: v[::-1] if k in moving else v for k, v in arrays.items()})


def crop(capture: Path, truth: Path) -> None:
    """Let three of the cameras see a part of the subject only: cut off the feet, the head, the right half."""
    windows = {1: (slice(0, 300), slice(None)), 4: (slice(190, None), slice(None)), 6: (slice(None), slice(0, 330))}
    opened = Capture.open(capture)
    rig, names = opened.rig, opened.cameras
    for c, (rows, columns) in windows.items():
        for file in (*(capture / "images" / names[c]).glob("*.png"), capture / "background" / f"{names[c]}.png"):
            cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[rows, columns])
        image = cv2.imread(str(capture / "images" / names[c] / "000000.png"))
        camera = rig.cameras[c]
        camera.principal_point_y -= rows.start or 0
        camera.height, camera.width = image.shape[:2]
    write_rig(capture / "sparse", rig)


def perfect_tracks(truth: Path, scans: Path) -> None:
    """Make tracks of the true surface, 8,000 points that are the same in all frames."""
    frames = _true_surfaces(truth)
    places = places_on(frames[0], 8000, seed=0)
    np.savez(scans, points=np.stack([places.of(surface.points) for surface in frames]))


def worse_tracks(noise: float = 0.0, length: int | None = None) -> Callable[[Path, Path], None]:
    """Make the same tracks with noise (standard deviation of a coordinate, metres), each there for `length` frames.

    These begin anywhere, also before the first frame.
    """

    def make(truth: Path, scans: Path) -> None:
        perfect_tracks(truth, scans)
        rng = np.random.default_rng(0)
        points = np.load(scans)["points"]
        points += noise * rng.standard_normal(points.shape)
        if length is not None:
            begin = rng.integers(1 - length, len(points), points.shape[1])
            since = np.arange(len(points))[:, None] - begin
            points[(since < 0) | (since >= length)] = np.nan
        np.savez(scans, points=points)

    return make


def fresh_samples(truth: Path, scans: Path) -> None:
    """Make scans of the true surface, 4,096 points in any order, sampled anew in each frame."""
    rng = np.random.default_rng(0)
    frames = enumerate(_true_surfaces(truth))
    np.savez(scans, points=np.stack([rng.permutation(places_on(s, 4096, seed=k).of(s.points)) for k, s in frames]))


def _true_surfaces(truth: Path) -> list[ScanSurface]:
    with np.load(truth / "truth.npz") as loaded:
        return [ScanSurface(vertices.astype(float), loaded["faces"]) for vertices in loaded["vertices"]]


def different_cameras(capture: Path, truth: Path) -> None:
    """Replace the eight cameras by quite different ones, half of them with videos, half of them without background.

    Lenses, image sizes, gains and offsets of the principal point differ; images flicker, are noisy and lossily
    compressed.
    """
    rng = np.random.default_rng(5)
    opened = Capture.open(capture)
    rig, names = opened.rig, opened.cameras
    cameras = []
    for c, (old, (model, size, distortion)) in enumerate(zip(rig.cameras, LENSES, strict=True)):
        camera = _camera(old, model, size, distortion)
        cameras.append(camera)
        x, y = _seen_at(old, camera)
        gain = rng.uniform(0.8, 1.2)

        def seen(file: Path, x: np.ndarray = x, y: np.ndarray = y, gain: float = gain) -> np.ndarray:
            image = cv2.remap(cv2.imread(str(file)), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
            light = gain * (1 + 0.01 * rng.standard_normal())
            return np.clip(light * image + 2.5 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)

        folder, background = capture / "images" / names[c], capture / "background" / f"{names[c]}.png"
        pictures = [seen(file) for file in sorted(folder.glob("*.png"))]
        shutil.rmtree(folder)
        if c % 2:
            (capture / "videos").mkdir(exist_ok=True)
            kind = cv2.VideoWriter.fourcc(*"mp4v")
            video = cv2.VideoWriter(str(capture / "videos" / f"{names[c]}.mp4"), kind, opened.fps, size)
            for picture in pictures:
                video.write(picture)
            video.release()
        else:
            folder.mkdir()
            for k, picture in enumerate(pictures):
                cv2.imwrite(str(folder / f"{k:06d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
        if c < len(LENSES) // 2:
            cv2.imwrite(str(background), seen(background))
        else:
            background.unlink()
    write_rig(capture / "sparse", Rig(rig.names, tuple(cameras), rig.cam_from_world))


def _camera(old: pycolmap.Camera, model: str, size: tuple[int, int], distortion: list[float]) -> pycolmap.Camera:
    """Return a camera that sees about what the old one does."""
    scale = size[0] / old.width
    focal = 0.97 * scale * old.mean_focal_length()
    middle = [scale * old.principal_point_x + 3, scale * old.principal_point_y - 2]
    lengths = [focal] if model == "SIMPLE_RADIAL" else [focal, focal]
    return pycolmap.Camera(model=model, width=size[0], height=size[1], params=lengths + middle + distortion)


def _seen_at(old: pycolmap.Camera, camera: pycolmap.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return where the old, undistorted camera has what the new one has in each pixel: array indices (H, W) x and y."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = camera.cam_from_img(np.stack([u.ravel(), v.ravel()], axis=1))
    fx, fy, cx, cy = (old.calibration_matrix()[i] for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y = fx * ray[:, 0] + cx - 0.5, fy * ray[:, 1] + cy - 0.5
    return x.reshape(u.shape).astype(np.float32), y.reshape(u.shape).astype(np.float32)
