"""Silhouettes of one frame, decided by all cameras together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.errors import CaptureError
from geomocap.silhouettes.background import BackgroundModel
from geomocap.silhouettes.colors import count_colors
from geomocap.silhouettes.evidence import background_misfit, smooth_evidence
from geomocap.silhouettes.light import light_change
from geomocap.silhouettes.likelihood import (
    CLASSES,
    SHADED,
    SIZES,
    SURE,
    UNSHADED,
    Counts,
    Likelihood,
    count_misfits,
    count_shaded,
    log_odds,
    shared_noise,
    size_class,
)
from geomocap.silhouettes.other_cameras import OtherCameras, Word, agreement
from geomocap.silhouettes.outline import refine_outline
from geomocap.silhouettes.pieces import clean
from geomocap.silhouettes.shadows import shadow_misfit
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

APART = 0.02  # certain background keeps so far away from the silhouette (part of the image's longer side)
CERTAIN = 2.0  # log odds, with the neighbours' vote, from which a camera is sure


@dataclass(frozen=True)
class CameraEvidence:
    """One camera's image, and how well the background explains it.

    Attributes
    ----------
    image : (H, W, 3) uint8
    model : BackgroundModel
    light : (3,) float32, twice
        Gain and offset of this frame against the background.
    misfit, shade : (H, W) float32
        Half the chi-square against the background, and against its shadow (infinite where that can't be).
    region : (H, W) bool or None
        Where the subject can be.
    """

    image: np.ndarray
    model: BackgroundModel
    light: tuple[np.ndarray, np.ndarray]
    misfit: np.ndarray
    shade: np.ndarray
    region: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        image: np.ndarray,
        model: BackgroundModel,
        settings: SilhouetteSettings,
        region: np.ndarray | None = None,
        shadows: bool = True,
    ) -> CameraEvidence:
        """Compare an image with the background in its light, and with its shadows if there are any.

        Raises
        ------
        CaptureError
            If image or region haven't the model's size.
        """
        model.check(image)
        if region is not None and region.shape != model.known.shape:
            raise CaptureError(
                f"region of interest {region.shape}: expected {model.known.shape}, the size of the images"
            )
        image = np.ascontiguousarray(image)
        gain, offset = np.ones(3), np.zeros(3)
        if settings.gain:
            gain, offset = light_change(image, model.mean, model.sigma, model.known)
        light = gain.astype(np.float32), offset.astype(np.float32)
        about = model.mean, model.sigma, model.known
        misfit = background_misfit(image, *about, *light)
        shade = np.full(misfit.shape, np.inf, np.float32)
        if settings.shadows and shadows:
            shade = shadow_misfit(misfit, image, *about, *light, settings.shadow_darkest, SHADED)
        return cls(image, model, light, misfit, shade, region)


@dataclass(frozen=True)
class Decision:
    """Silhouettes of one frame and what led to them, by camera.

    Attributes
    ----------
    masks : tuple of C arrays (H, W) bool
    own : tuple of C arrays (H, W) float32
        Log odds of each pixel from its own camera alone.
    voted : tuple of C arrays (H, W) float32
        The same with the neighbours' vote.
    words : tuple of C Word, or None
        What the others say; None if they can't confirm anything.
    """

    masks: tuple[np.ndarray, ...]
    own: tuple[np.ndarray, ...]
    voted: tuple[np.ndarray, ...]
    words: tuple[Word, ...] | None


def decide(
    views: Sequence[CameraEvidence],
    likelihood: Likelihood,
    others: OtherCameras | None,
    settings: SilhouetteSettings,
) -> Decision:
    """Decide which pixels are subject.

    Each camera's log odds, its neighbours' vote, and what the others say: without limit against a pixel,
    for it not more than the others' confirmation is worth.

    Parameters
    ----------
    views : C of CameraEvidence
    likelihood : Likelihood
    others : OtherCameras or None
        None: each camera decides alone.
    settings : SilhouetteSettings
    """
    own, voted = [], []
    for c, view in enumerate(views):
        odds = log_odds(view.image, view.model, view.misfit, view.shade, likelihood, c)
        if view.region is not None:
            odds[~view.region] = -SURE
        own.append(odds)
        voted.append(smooth_evidence(odds, view.image, view.model.sigma))
    words = others.words(voted) if others is not None else None
    masks = []
    for c, view in enumerate(views):
        odds, vote, said = own[c], voted[c], None
        if words is not None:
            said = words[c].odds
            word = np.minimum(said, likelihood.bonus(words[c].size))
            odds, vote = odds + word, vote + word
        masks.append(_finish(view, vote > 0, odds, said, float(likelihood.alike[c]), settings))
    return Decision(tuple(masks), tuple(own), tuple(voted), None if words is None else tuple(words))


def _finish(
    view: CameraEvidence,
    mask: np.ndarray,
    odds: np.ndarray,
    words: np.ndarray | None,
    alike: float,
    settings: SilhouetteSettings,
) -> np.ndarray:
    """Undo pieces and holes that aren't real, and take the outline to half a pixel."""
    mask = clean(mask, odds, alike, settings.smallest, words)
    part = bounding_slices(mask, 4)
    model = view.model
    image, mean, known, sigma = (
        np.ascontiguousarray(a[part]) for a in (view.image, model.mean, model.known, model.sigma)
    )
    mask[part] = refine_outline(np.ascontiguousarray(mask[part]), image, mean, known, sigma, *view.light)
    if view.region is not None:
        mask &= view.region
    return mask


def count(views: Sequence[CameraEvidence], decision: Decision) -> Counts:
    """Count what a decision holds for certain: the likelihood's noise, colours, and worth of confirmation."""
    misfits, alike = [], []
    confirmed, shaded = np.zeros((2, SIZES)), np.zeros((2, CLASSES + 1))
    colors: np.ndarray | float = 0.0
    for c, (view, mask, own, vote) in enumerate(zip(views, decision.masks, decision.own, decision.voted, strict=True)):
        reach = 2 * round(APART * max(mask.shape)) + 1
        certain = (cv2.dilate(mask.view(np.uint8), np.ones((reach, reach), np.uint8)) == 0) & view.model.known
        sure = cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool) & (vote > CERTAIN)
        fits = (view.shade < SHADED) & (view.misfit > UNSHADED)
        if view.region is not None:
            certain &= view.region
        if decision.words is not None:
            word = decision.words[c]
            agreed = word.odds >= agreement(len(views))
            certain &= ~agreed
            sure &= word.odds >= 0
            classes = size_class(word.size)
            confirmed += [np.bincount(classes[agreed & a], minlength=SIZES) for a in (vote < -CERTAIN, sure)]
            near = bounding_slices(mask, reach * 4)
            inner = cv2.erode(agreed.view(np.uint8), np.ones((reach // 2, reach // 2), np.uint8)).view(bool)
            shaded += [count_shaded(view.shade, fits & a, a) for a in (_within(certain, near), inner)]
        misfits.append(count_misfits(view.misfit[::2, ::2], (certain & ~fits)[::2, ::2]))
        alike.append([shared_noise(own, certain), 1.0])
        colors = colors + count_colors(view.image, sure & ~fits)
    return Counts(np.array(misfits), np.asarray(colors), shaded, confirmed, np.array(alike))


def _within(mask: np.ndarray, part: tuple[slice, slice]) -> np.ndarray:
    """The mask in a part of the image, and nothing elsewhere."""
    result = np.zeros_like(mask)
    result[part] = mask[part]
    return result


def learn_from(views: Sequence[CameraEvidence], others: OtherCameras | None, settings: SilhouetteSettings) -> Counts:
    """Count what one frame tells: decided with nothing learnt, then once more with what that gave."""
    unlearnt = Likelihood.unlearnt(len(views), alone=others is None)
    first = count(views, decide(views, unlearnt, others, settings))
    return count(views, decide(views, Likelihood.of(first), others, settings))


def silhouette(
    image: np.ndarray,
    model: BackgroundModel,
    settings: SilhouetteSettings | None = None,
    region: np.ndarray | None = None,
) -> np.ndarray:
    """Cut out what stands before the background of one camera, with a likelihood learnt from the image itself.

    Parameters
    ----------
    image : (H, W, 3) uint8
        Frame, RGB.
    model : BackgroundModel
        Of the same camera.
    settings : SilhouetteSettings, optional
    region : (H, W) bool, optional
        Only within this region; see `region_of_points`.

    Returns
    -------
    (H, W) uint8
        0 or 255. Empty or full if the image says so: check its `coverage`.

    Raises
    ------
    CaptureError
        If image or region haven't the model's size.
    """
    settings = settings or SilhouetteSettings()
    views = [CameraEvidence.of(image, model, settings, region)]
    likelihood = Likelihood.of(learn_from(views, None, settings))
    return decide(views, likelihood, None, settings).masks[0].astype(np.uint8) * np.uint8(255)


def coverage(mask: np.ndarray, region: np.ndarray | None = None) -> float:
    """Return the fraction of the image (or of the region) that a silhouette covers: 0 empty, 1 full."""
    if region is not None:
        mask = mask[region]
    return float(np.count_nonzero(mask)) / max(1.0, float(mask.size))


def bounding_slices(mask: np.ndarray, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns of the smallest box round what is true in (H, W) bool, with a margin in pixels."""
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    return slice(max(0, y - margin), y + h + margin), slice(max(0, x - margin), x + w + margin)
