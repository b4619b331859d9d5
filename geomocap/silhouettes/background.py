"""Background model of a camera: what it sees without the subject, how noisy that is, and where it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numba import njit, prange

from geomocap.errors import CaptureError
from geomocap.silhouettes.background_noise import noise
from geomocap.silhouettes.enclosed_regions import enclosed
from geomocap.silhouettes.light import light_change
from geomocap.silhouettes.recurrence import ALIKE, WINDOW, recurrences
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

TEXTURE_WINDOW = 5  # pixels along its side
LIT = 0.15  # fraction of the frames that must show a place lit for the others to be its shadow


@dataclass(frozen=True)
class BackgroundModel:
    """What a static camera sees without the subject.

    Attributes
    ----------
    mean : (H, W, 3) float32
        Background, grey levels, RGB.
    sigma : (H, W) float32
        Standard deviation of a frame against it (per channel), grey levels.
    known : (H, W) bool
        Where the background is known.
    camera : str
        Name of the camera, for messages.
    texture : (H, W) float32
        Variance of the background within small windows, slopes left out, in variances of the noise.
        Made from the others.
    """

    mean: np.ndarray
    sigma: np.ndarray
    known: np.ndarray
    camera: str = ""
    texture: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        shape = np.shape(self.known)
        if len(shape) != 2 or self.mean.shape != (*shape, 3) or self.sigma.shape != shape:
            raise CaptureError(
                f"background{_of(self.camera)}: mean {self.mean.shape}, sigma {self.sigma.shape} and known {shape} "
                "don't fit; expected (H, W, 3), (H, W) and (H, W)"
            )
        object.__setattr__(self, "mean", np.ascontiguousarray(self.mean, np.float32))
        object.__setattr__(self, "sigma", np.ascontiguousarray(self.sigma, np.float32))
        object.__setattr__(self, "known", np.ascontiguousarray(self.known, bool))
        object.__setattr__(self, "texture", _texture(self.mean, self.sigma))

    @cached_property
    def log_sigma(self) -> np.ndarray:
        """Natural logarithm of `sigma`, (H, W) float32."""
        return logarithms(self.sigma)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.known.shape[1], self.known.shape[0]

    def check(self, image: np.ndarray) -> None:
        """Raise CaptureError if an image is no (H, W, 3) uint8 of this size."""
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise CaptureError(f"image{_of(self.camera)}: {image.shape} {image.dtype}; expected (H, W, 3) uint8")
        if image.shape[:2] != self.known.shape:
            w, h = self.size
            raise CaptureError(
                f"background{_of(self.camera)}: {w}×{h} pixels, but the images are {image.shape[1]}×{image.shape[0]}; "
                "take the background picture with the settings of the recording"
            )


def _of(camera: str) -> str:
    return f" of camera {camera}" if camera else ""


def model_from_plate(
    plate: np.ndarray,
    frames: Sequence[np.ndarray],
    settings: SilhouetteSettings | None = None,
    camera: str = "",
) -> BackgroundModel:
    """Make the background model from a picture of the empty scene and some frames of the recording.

    The frames give the noise, and, where they agree with the plate, a background with less noise than the plate's own.

    Parameters
    ----------
    plate : (H, W, 3) or (H, W, 4) uint8
        Empty scene, RGB or RGBA; alpha 0 marks pixels where the background isn't known.
    frames : sequence of (H, W, 3) uint8
        Some frames spread over the recording; about 10 are enough.
    settings : SilhouetteSettings, optional
    camera : str
        Name of the camera, for messages.

    Raises
    ------
    CaptureError
        If the plate's size isn't the frames', or there are no frames.
    """
    settings = settings or SilhouetteSettings()
    if not len(frames):
        raise CaptureError(f"background{_of(camera)}: no frames to measure the noise on; expected at least one")
    known = plate[..., 3] > 127 if plate.shape[-1] == 4 else np.ones(plate.shape[:2], bool)
    mean = plate[..., :3].astype(np.float32)
    model = BackgroundModel(mean, np.full(known.shape, 2.0, np.float32), known, camera)
    for image in frames:
        model.check(image)
    for _ in range(2):
        lights = [_light(image, model, settings) for image in frames]
        sigma = noise(frames, lights, model.mean, model.known)
        model = BackgroundModel(_agreeing_mean(frames, lights, mean, sigma), sigma, known, camera)
    return model


def model_from_frames(
    frames: Sequence[np.ndarray], settings: SilhouetteSettings | None = None, camera: str = ""
) -> BackgroundModel:
    """Estimate the background over time: at each pixel the colour that comes back most often with its surroundings.

    Where too few frames agree (the subject never leaves, and moves), and where what doesn't change is enclosed by what
    does (the subject's middle never leaves), the background is unknown.

    Parameters
    ----------
    frames : sequence of (H, W, 3) uint8
        Frames spread over the recording; 20 to 40 are enough.
    settings : SilhouetteSettings, optional
    camera : str
        Name of the camera, for messages.

    Raises
    ------
    CaptureError
        If there are fewer than three frames, or their sizes differ.
    """
    settings = settings or SilhouetteSettings()
    mean, sigma, support = background_over_time(frames, settings, camera)
    model = BackgroundModel(mean, sigma, support >= max(settings.support, 2.0 / len(frames)), camera)
    changed = np.stack([_changed(image, model, settings) for image in frames])
    return BackgroundModel(mean, sigma, model.known & ~enclosed(mean, changed), camera)


def _changed(image: np.ndarray, model: BackgroundModel, settings: SilhouetteSettings) -> np.ndarray:
    """Where an image differs from the background by more than 3 sigma in any channel, (H, W) uint8."""
    gain, offset = (a.astype(np.float32) for a in _light(image, model, settings))
    away = np.abs((image - offset) / gain - model.mean).max(axis=-1)
    return (away > 3.0 * model.sigma).astype(np.uint8)


def background_over_time(
    frames: Sequence[np.ndarray], settings: SilhouetteSettings, camera: str = ""
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find at each pixel the colour that comes back with its surroundings in the most frames, and how many agree on it.

    Parameters
    ----------
    frames, settings, camera
        As in `model_from_frames`.

    Returns
    -------
    mean : (H, W, 3) float32
    sigma : (H, W) float32
        Noise, grey levels.
    support : (H, W) float32
        Fraction of the frames.

    Raises
    ------
    CaptureError
        If there are fewer than three frames, or their sizes differ.
    """
    if len(frames) < 3:
        raise CaptureError(
            f"background{_of(camera)}: {len(frames)} frames; an estimate over time needs at least 3: "
            "record more, or add an empty picture to background/"
        )
    shape = frames[0].shape[:2]
    flat = BackgroundModel(np.zeros((*shape, 3)), np.ones(shape), np.ones(shape, bool), camera)
    for image in frames:
        flat.check(image)
    stack = np.stack(list(frames))
    median = np.median(stack, axis=0).astype(np.float32)
    known = np.ones(median.shape[:2], bool)
    model = BackgroundModel(median, np.full(known.shape, 2.0, np.float32), known, camera)
    lights = [_light(image, model, settings) for image in frames]
    sigma = noise(frames, lights, model.mean, model.known)
    gains = np.array([g for g, _ in lights], np.float32)
    offsets = np.array([o for _, o in lights], np.float32)
    windows = recurrences(stack, gains, offsets, 3.0 * sigma, WINDOW, ALIKE)
    mean, support = agreement(stack, gains, offsets, 3.0 * sigma, windows, LIT)
    model = BackgroundModel(mean, sigma, known, camera)
    return mean, noise(frames, lights, model.mean, model.known), support


def _light(image: np.ndarray, model: BackgroundModel, settings: SilhouetteSettings) -> tuple[np.ndarray, np.ndarray]:
    if not settings.gain:
        return np.ones(3), np.zeros(3)
    return light_change(image, model.mean, model.sigma, model.known)


@njit(cache=True, nogil=True, error_model="numpy")
def logarithms(values):
    """Natural logarithms of (H, W) float32, as kernels take them: NumPy's own differ in the last place."""
    out = np.empty_like(values)
    for y in range(values.shape[0]):
        for x in range(values.shape[1]):
            out[y, x] = np.log(values[y, x])
    return out


def _texture(mean: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Variance within windows less that of noise, in variances of the noise: (H, W) float32."""
    window = (TEXTURE_WINDOW, TEXTURE_WINDOW)
    fine = mean - cv2.blur(mean, window)
    variance = cv2.blur((fine * fine).mean(axis=-1), window)
    return np.maximum(np.float32(0), variance / (sigma * sigma) - np.float32(1))


def _agreeing_mean(
    frames: Sequence[np.ndarray],
    lights: Sequence[tuple[np.ndarray, np.ndarray]],
    plate: np.ndarray,
    sigma: np.ndarray,
) -> np.ndarray:
    """Mean of the plate and the frames that agree with it within 3 sigma in all channels."""
    total, count = plate.copy(), np.ones(sigma.shape, np.float32)
    for image, (gain, offset) in zip(frames, lights, strict=True):
        relit = ((np.arange(256)[:, None] - offset) / gain).astype(np.float32)
        add_agreeing(np.ascontiguousarray(image), relit, plate, sigma, total, count)
    return total / count[..., None]


@njit(cache=True, nogil=True, error_model="numpy")
def add_agreeing(image, relit, plate, sigma, total, count):
    """Add a frame to the sum and the count of frames, where it agrees with the plate within 3 sigma in all channels.

    Parameters
    ----------
    image : (H, W, 3) uint8
    relit : (256, 3) float32
        What each grey level of a channel would be in the plate's light.
    plate : (H, W, 3) float32
    sigma : (H, W) float32
    total, count : (H, W, 3), (H, W) float32
        Changed in place.
    """
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            a, b, c = relit[image[y, x, 0], 0], relit[image[y, x, 1], 1], relit[image[y, x, 2], 2]
            reach = np.float32(3.0) * sigma[y, x]
            if abs(a - plate[y, x, 0]) < reach and abs(b - plate[y, x, 1]) < reach and abs(c - plate[y, x, 2]) < reach:
                total[y, x, 0] += a
                total[y, x, 1] += b
                total[y, x, 2] += c
                count[y, x] += np.float32(1.0)


@njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def agreement(stack, gains, offsets, reach, windows, lit):
    """Find at each pixel the colour that comes back with its surroundings in the most frames.

    Parameters
    ----------
    stack : (T, H, W, 3) uint8
    gains, offsets : (T, 3) float32
        Light of each frame, frame = gain · background + offset.
    reach : (H, W) float32
        Colours within this distance in every channel agree, grey levels.
    windows : (T, H, W) uint16
        Frames in which the surroundings come back, see `recurrences`. Where that is alike, the most frames decide.
    lit : float
        Fraction of the frames from which a smaller group is preferred of which the largest one is a shadow.

    Returns
    -------
    mean : (H, W, 3) float32
        Mean of the colours that agree with it (the first of equals), or with the one that it is a shadow of.
    support : (H, W) float32
        Fraction of the frames that agree.
    """
    n, h, w = stack.shape[0], stack.shape[1], stack.shape[2]
    mean = np.empty((h, w, 3), np.float32)
    support = np.empty((h, w), np.float32)
    for y in prange(h):
        values = np.empty((n, 3), np.float32)
        counts = np.empty(n, np.int64)
        for x in range(w):
            for t in range(n):
                for c in range(3):
                    values[t, c] = (np.float32(stack[t, y, x, c]) - offsets[t, c]) / gains[t, c]
            limit = reach[y, x]
            best = 0
            for t in range(n):
                counts[t] = 0
                for u in range(n):
                    if (
                        abs(values[u, 0] - values[t, 0]) <= limit
                        and abs(values[u, 1] - values[t, 1]) <= limit
                        and abs(values[u, 2] - values[t, 2]) <= limit
                    ):
                        counts[t] += 1
            for t in range(1, n):
                here, there = windows[t, y, x], windows[best, y, x]
                if here > there or (here == there and counts[t] > counts[best]):
                    best = t
            shaded = best
            for t in range(n):
                if counts[t] >= max(2, lit * n) and (shaded == best or counts[t] > counts[best]):
                    if _shades(values[t], values[shaded], limit):
                        best = t
            most = counts[best]
            for c in range(3):
                total = np.float32(0.0)
                for u in range(n):
                    if (
                        abs(values[u, 0] - values[best, 0]) <= limit
                        and abs(values[u, 1] - values[best, 1]) <= limit
                        and abs(values[u, 2] - values[best, 2]) <= limit
                    ):
                        total += values[u, c]
                mean[y, x, c] = total / most
            support[y, x] = most / n
    return mean, support


@njit(cache=True, nogil=True, error_model="numpy")
def _shades(light, dark, limit):
    """Whether `dark` is `light` under a shadow: the same colour, times 0.3 to 0.95."""
    both = light[0] * dark[0] + light[1] * dark[1] + light[2] * dark[2]
    factor = both / (light[0] * light[0] + light[1] * light[1] + light[2] * light[2] + np.float32(1e-6))
    if not (0.3 < factor < 0.95):
        return False
    for c in range(3):
        if abs(dark[c] - factor * light[c]) > limit:
            return False
    return True
