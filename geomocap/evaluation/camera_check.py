"""Do the cameras of a capture fit together? Asked of few small pictures, each camera by itself, before any long work.

The silhouettes of a run are decided by all cameras together, so that a wrong one is overruled and looks right. Here
each camera decides alone; who contradicts the others is named (`silhouettes.contradictions`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.carving.silhouette_views import Undistortion
from geomocap.files.capture import Capture
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.rig import reduction
from geomocap.model.rig_doubts import rig_doubts
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items
from geomocap.silhouettes.background import model_from_frames, model_from_plate
from geomocap.silhouettes.contradictions import Contradiction, OwnSilhouettes, find_contradictions
from geomocap.silhouettes.silhouette_scene import SilhouetteScene
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

LONGEST = 160  # longer side of the pictures that are looked at, pixels
FRAMES = 6  # spread over the recording
SAMPLES = 16  # frames that show the background of a camera without a picture of it
BACKGROUND_FRAMES = 10  # frames without a background picture don't show what moves
FLAT = 2  # grey levels between the darkest and the brightest pixel of a picture that shows nothing


@dataclass(frozen=True)
class CameraCheck:
    """What is doubtful about the cameras of a capture.

    Attributes
    ----------
    contradicting : tuple of str
        Cameras that contradict the others; leaving them out may help.
    warnings : tuple of str
        One line each, on these and other doubts.
    """

    contradicting: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class CameraLook:
    """What a camera shows by itself.

    Attributes
    ----------
    scene : SilhouetteScene or None
        Its background, and how the subject differs; None if that can't be told.
    masks : tuple of F arrays (H, W) uint8 or None
        Silhouettes.
    warnings : tuple of str
    blank : bool
        Whether its pictures show nothing.
    plate, median : (H, W, 3) uint8 or None
        Background picture, and what the frames show mostly.
    """

    scene: SilhouetteScene | None
    masks: tuple[np.ndarray, ...] | None
    warnings: tuple[str, ...] = ()
    blank: bool = False
    plate: np.ndarray | None = None
    median: np.ndarray | None = None


def check_cameras_of(
    capture: Capture,
    settings: SilhouetteSettings | None = None,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> CameraCheck:
    """Look for cameras that contradict the others, and for other doubts about them.

    Parameters
    ----------
    capture : Capture
        Calibrated.
    settings : SilhouetteSettings, optional
    executor : Executor, optional
        Cameras are mapped with it.
    progress : Progress
    """
    rig = capture.rig if capture.is_calibrated else None
    doubts = rig_doubts(rig) if rig is not None else []
    frames = evenly_chosen(capture.n_frames, FRAMES).tolist()
    look = _Look(capture, tuple(frames), settings or SilhouetteSettings())
    looks = list(map_items(look, capture.cameras, executor, "cameras", progress, 4))
    warnings = [w for found in looks for w in found.warnings]
    warnings += mixed_up(dict(zip(capture.cameras, looks, strict=True)))
    blank = [name for name, found in zip(capture.cameras, looks, strict=True) if found.blank]
    seen = {name: found for name, found in zip(capture.cameras, looks, strict=True) if found.masks is not None}
    names = list(seen)
    contradictions: tuple[Contradiction, ...] = ()
    if rig is not None and len(names) > 1:
        small = rig.select(names).reduced(LONGEST)
        masks = [[found.masks[k] for found in seen.values() if found.masks is not None] for k in range(len(frames))]
        scenes = [found.scene for found in seen.values()]

        def moments(camera: int, numbers: Sequence[int]) -> list[np.ndarray]:
            return [look.silhouette(names[camera], k, scenes[camera]) for k in numbers]

        evidence = OwnSilhouettes.of(Undistortion.of(small), masks, frames)
        contradictions = find_contradictions(evidence, capture.n_frames, moments)
    contradicting = [c for found in contradictions for c in found.cameras if len(found.cameras) < max(3, len(names))]
    return CameraCheck(
        tuple(dict.fromkeys([*blank, *contradicting])),
        tuple(dict.fromkeys([*doubts, *warnings, *map(str, contradictions)])),
    )


def mixed_up(looks: Mapping[str, CameraLook]) -> list[str]:
    """Name background pictures that another camera's pictures look much more like than the camera's own."""
    found = []
    for name, look in looks.items():
        if look.plate is None or look.median is None:
            continue
        own = _difference(look.median, look.plate)
        others = {
            other: _difference(there.median, look.plate)
            for other, there in looks.items()
            if other != name and there.median is not None and there.median.shape == look.plate.shape
        }
        other = min(others, key=lambda n: others[n], default=name)
        if own > FLAT and others.get(other, own) < own / 2:
            found.append(f"background/{name}.png: camera {other} sees that, not camera {name}")
    return found


def _difference(image: np.ndarray, plate: np.ndarray) -> float:
    """Median difference of two pictures but for the light; what covers less than half of them doesn't count."""
    difference = image.astype(np.float32) - plate
    return float(np.median(np.abs(difference - np.median(difference, axis=(0, 1)))))


def _is_grey(image: np.ndarray) -> bool:
    return int(np.ptp(image[..., :3].astype(np.int16), axis=-1).max()) <= FLAT


@dataclass(frozen=True)
class _Look:
    """Looks at one camera by itself."""

    capture: Capture
    frames: tuple[int, ...]
    settings: SilhouetteSettings

    def __call__(self, camera: str) -> CameraLook:
        capture = self.capture
        if capture.has_masks:
            return CameraLook(None, tuple(self.silhouette(camera, k, None) for k in self.frames))
        source, chosen = capture.sources[camera], self._background_frames(camera)
        shown = [capture.first + k for k in self.frames]
        known = {n: self._shrink(camera, source.read(n)) for n in sorted({*shown, *chosen})}  # a video is decoded once
        images = [known[n] for n in shown]
        if max(int(np.ptp(image)) for image in images) <= FLAT:
            return CameraLook(None, None, (f"camera {camera}: its pictures show nothing but one colour",), True)
        warnings = []
        plate = None
        if capture.has_background(camera):
            plate = self._shrink(camera, capture.background(camera))
            if _is_grey(plate) and not _is_grey(np.concatenate(images)):
                warnings.append(f"background/{camera}.png: is grey, the pictures of the camera are in colour")
            if (plate[..., 3] > 127).mean() < 0.5:
                warnings.append(f"background/{camera}.png: most of it is transparent, so the background isn't known")
            model = model_from_plate(plate, images, self.settings, camera)
        else:
            if any(map(capture.has_background, capture.cameras)):
                warnings.append(f"background/{camera}.png: is missing; the background is estimated from the frames")
            if capture.n_recorded < BACKGROUND_FRAMES:
                return CameraLook(None, None, tuple(warnings))
            model = model_from_frames([known[n] for n in chosen], self.settings, camera)
        scene = SilhouetteScene.unlearnt([model], None, self.settings)
        scene = scene.learnt([scene.count([image]) for image in images])
        masks = tuple(scene.alone([image])[0] for image in images)
        always = float(np.min(masks, axis=0).mean())
        if always > 0.5 and capture.has_background(camera):
            warnings.append(
                f"background/{camera}.png: differs from all pictures of the camera in {always:.0%} of the picture; is "
                "it of this camera and this recording?"
            )
        median = np.median(images, axis=0).astype(np.uint8)
        return CameraLook(scene, masks, tuple(warnings), False, None if plate is None else plate[..., :3], median)

    def _background_frames(self, camera: str) -> list[int]:
        """Frames, numbered as recorded, that tell the background of a camera; none where that is known or can't be."""
        capture = self.capture
        if capture.has_background(camera) or capture.n_recorded < BACKGROUND_FRAMES:
            return []
        return evenly_chosen(len(capture.sources[camera]), min(self.settings.samples, SAMPLES)).tolist()

    def silhouette(self, camera: str, frame: int, scene: SilhouetteScene | None) -> np.ndarray:
        """Silhouette of a frame in a small image, (H, W) uint8."""
        if scene is None:
            return (self._shrink(camera, self.capture.mask(camera, frame)) > 127).view(np.uint8)
        return scene.alone([self.small(camera, frame)])[0]

    def small(self, camera: str, frame: int) -> np.ndarray:
        """Read a picture and shrink it."""
        return self._shrink(camera, self.capture.frame(camera, frame))

    def _shrink(self, camera: str, image: np.ndarray) -> np.ndarray:
        width, height = self.capture.sources[camera].size
        factor = reduction(width, height, LONGEST)
        return np.asarray(cv2.resize(image, (width // factor, height // factor), interpolation=cv2.INTER_AREA))
