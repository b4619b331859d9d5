"""What the silhouettes of a recording need: backgrounds, how subject and background differ, and the other cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from geomocap.carving.holes import fill_false_holes
from geomocap.carving.silhouette_views import Undistortion
from geomocap.errors import CaptureError
from geomocap.model.rig import Rig
from geomocap.silhouettes.background import BackgroundModel, model_from_frames, model_from_plate
from geomocap.silhouettes.joint_decision import CameraEvidence, decide, learn_from
from geomocap.silhouettes.likelihood import Counts, Likelihood
from geomocap.silhouettes.other_cameras import OtherCameras, large_pieces
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

LEARNING_FRAMES = 6  # spread over the recording


@dataclass(frozen=True)
class SilhouetteScene:
    """What the silhouettes of any frame of a recording need.

    Attributes
    ----------
    settings : SilhouetteSettings
    models : tuple of C BackgroundModel
    regions : tuple of C arrays (H, W) bool or None
        Where the subject can be in each image.
    rig : Rig or None
        None: the cameras are not calibrated, and each decides alone.
    others : OtherCameras or None
    undistortion : Undistortion or None
    likelihood : Likelihood
        How subject and background differ, in all cameras.
    """

    settings: SilhouetteSettings
    models: tuple[BackgroundModel, ...]
    regions: tuple[np.ndarray | None, ...]
    rig: Rig | None
    others: OtherCameras | None
    undistortion: Undistortion | None
    likelihood: Likelihood

    @classmethod
    def unlearnt(
        cls,
        models: Sequence[BackgroundModel],
        rig: Rig | None,
        settings: SilhouetteSettings,
        regions: Sequence[np.ndarray | None] | None = None,
    ) -> SilhouetteScene:
        """Return a scene of which only the backgrounds are known yet."""
        together = rig if settings.joint and rig is not None and len(models) > 1 else None
        return cls(
            settings,
            tuple(models),
            tuple(regions or [None] * len(models)),
            together,
            None if together is None else OtherCameras.of(together),
            None if together is None else Undistortion.of(together),
            Likelihood.unlearnt(len(models)),
        )

    def learnt(self, counts: Iterable[Counts]) -> SilhouetteScene:
        """Return the scene with what the counts of some frames tell of subject and background."""
        return replace(self, likelihood=Likelihood.of(reduce(add, counts)))

    def count(self, images: Sequence[np.ndarray]) -> Counts:
        """Count what the images of one frame tell about subject and background."""
        return learn_from(self._evidence(images), self.others, self.settings)

    def silhouettes(self, images: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        """Cut out the silhouettes of one frame, C arrays (H, W) bool, from its C images (H, W, 3) uint8."""
        masks = decide(self._evidence(images), self.likelihood, self.others, self.settings).masks
        if self.undistortion is None or self.rig is None:
            return masks
        given = [m.astype(np.uint8) * np.uint8(255) for m in masks]
        return tuple(m > 0 for m in fill_false_holes(self.rig, self.undistortion.views(given), given))

    def alone(self, images: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        """Say what each camera takes for the subject by itself, C arrays (H, W) uint8: large pieces, as they are."""
        voted = decide(self._evidence(images), self.likelihood, None, self.settings).voted
        return tuple(large_pieces(odds > 0) for odds in voted)

    def _evidence(self, images: Sequence[np.ndarray]) -> list[CameraEvidence]:
        """Compare the images of a frame with the backgrounds."""
        shadows = bool(np.isfinite(self.likelihood.shadow).any())
        return [
            CameraEvidence.of(image, model, self.settings, region, shadows)
            for image, model, region in zip(images, self.models, self.regions, strict=True)
        ]


def learning_frames(count: int) -> list[int]:
    """Frames, spread over a recording of so many, from which it is learnt how subject and background differ."""
    return np.unique(np.linspace(0, count - 1, min(LEARNING_FRAMES, count)).round().astype(int)).tolist()


def find_silhouettes(
    images: Sequence[Sequence[np.ndarray]],
    rig: Rig | None = None,
    *,
    backgrounds: Sequence[np.ndarray] | None = None,
    settings: SilhouetteSettings | None = None,
) -> list[tuple[np.ndarray, ...]]:
    """Cut the subject out of the images of a recording; calibrated cameras decide together.

    Parameters
    ----------
    images : sequence of T sequences of C arrays (H, W, 3) uint8, RGB
        Of each frame the images of all cameras.
    rig : Rig, optional
        The C cameras; without it each camera decides alone.
    backgrounds : sequence of C arrays (H, W, 3) uint8, optional
        The empty scene; otherwise learnt from the frames, in which the subject has to move.
    settings : SilhouetteSettings, optional

    Returns
    -------
    list of T tuples of C arrays (H, W) bool

    Raises
    ------
    CaptureError
        If images, backgrounds and cameras don't fit together.
    """
    settings = settings or SilhouetteSettings()
    if not len(images) or len({len(frame) for frame in images}) != 1:
        raise CaptureError("silhouettes: expected frames with an image of each camera, the same number in all")
    cameras = len(images[0])
    if (backgrounds is not None and len(backgrounds) != cameras) or (rig is not None and len(rig) != cameras):
        raise CaptureError(f"silhouettes: {cameras} images a frame, but not as many backgrounds or cameras")
    some = np.unique(np.linspace(0, len(images) - 1, min(settings.samples, len(images))).round().astype(int))
    models = []
    for c in range(cameras):
        frames, name = [images[k][c] for k in some], rig.names[c] if rig is not None else str(c)
        if backgrounds is not None:
            models.append(model_from_plate(backgrounds[c], frames, settings, name))
        else:
            models.append(model_from_frames(frames, settings, name))
    scene = SilhouetteScene.unlearnt(models, rig, settings)
    scene = scene.learnt(scene.count(images[k]) for k in learning_frames(len(images)))
    return [scene.silhouettes(frame) for frame in images]
