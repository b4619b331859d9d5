"""Log likelihood ratio of a pixel, subject : background, calibrated on what is certain to be the one or the other.

The misfit of a pixel (half its chi-square against the background) has the noise model's word only; how often
which misfit really occurs is counted in certain background. The colours of the subject are counted in certain
subject, in all cameras: a camera before whose background the subject is hard to see knows its colours from the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.silhouettes.background import BackgroundModel
from geomocap.silhouettes.colors import LEVEL, LEVELS, color_density

SIZES = 8  # classes of the size of what the other cameras confirm: up to 1/2 voxel, 1, 2, 4 …
SURE = 6.0  # no pixel counts for more than exp(6) : 1 either way
OUTLIER = 5e-3  # fraction of the background's pixels that can have any colour
UNKNOWN = 1.0  # log odds where the background was never seen: something stood before it all the time
BINS = np.concatenate([np.linspace(0, 4, 17), np.arange(5.0, 17.0), 2.0 ** np.arange(4, 9.6, 0.5)[1:]])  # of misfits
QUARTERS = int(
    4 * BINS[-1]
)  # quarters of the misfit that have a density of their own; the last one stands for all above
UNSHADED = 12.0  # misfit that noise hardly reaches: below, a pixel needs no shadow
SHADED = 12.0  # misfit of a shadow from which it explains nothing
CLASSES = 24  # of the misfit of a shadow
LEAST_SHADOWS = 1e-4  # fraction of the background round the subject; fewer are none
ASKED, ALONE = -2.0, -4.0  # log odds before a shadow that fits, unlearnt: if others are asked, and if not
TEXTURE_SAMPLES = 8.0  # independent samples that a window's texture counts for


@dataclass(frozen=True)
class Counts:
    """What learning counts in one frame, or in several.

    Attributes
    ----------
    misfits : (C, K) float
        Pixels of certain background of each camera by the class of their misfit (`BINS`).
    colors : (LEVELS³,) float
        Pixels of certain subject by the class of their colour, all cameras together.
    shaded : (2, CLASSES + 1) float
        Pixels of certain background round the subject, and of subject that the other cameras confirm, all cameras
        together: that fit a shadow, by class of its misfit, and all of them.
    confirmed : (2, SIZES) float
        Of the pixels that the other cameras confirm, all cameras together, by the size of what they confirm: those that
        their own camera is sure are background, and subject.
    alike : (C, 2) float
        Sum over frames of how many pixels fraction their noise, and the number of frames that it was measured in.
    """

    misfits: np.ndarray
    colors: np.ndarray
    shaded: np.ndarray
    confirmed: np.ndarray
    alike: np.ndarray

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.misfits + other.misfits,
            self.colors + other.colors,
            self.shaded + other.shaded,
            self.confirmed + other.confirmed,
            self.alike + other.alike,
        )


@dataclass(frozen=True)
class Likelihood:
    """Densities of colours before each camera, and what the word of the others is worth.

    Attributes
    ----------
    background : (C, QUARTERS) float32
        Log density of a colour by its misfit, per grey level³ and times sigma³.
    subject : (LEVELS, LEVELS, LEVELS) float32
        Log density of the subject's colours, per grey level³.
    shadow : (CLASSES,) float
        Log odds of a pixel that fits a shadow by its misfit, in all cameras; infinite: there are no shadows to be
        looked for.
    worth : (SIZES,) float
        Log odds that a pixel is subject if the other cameras confirm it, by class of size.
    alike : (C,) float
        How many neighbouring pixels fraction their noise: 1 if it is independent.
    """

    background: np.ndarray
    subject: np.ndarray
    shadow: np.ndarray
    worth: np.ndarray
    alike: np.ndarray

    def bonus(self, size: np.ndarray) -> np.ndarray:
        """Log odds of pixels by the size (H, W) of what the other cameras confirm there; 0 where that is nothing.

        The worth of a class is reached in the middle of the next one: at outlines sizes are least sure, and more makes
        these grow. Reached in the middle of the class itself the mean overlap of eight captures would be 0.0008 less,
        at its end 0.0001, and of small images of a fan 0.0012 less.
        """
        result = np.zeros(size.shape, np.float32)
        confirmed = size > 0
        result[confirmed] = np.interp(_octaves(size[confirmed]), np.arange(SIZES) - 0.5, self.worth)
        return result

    @classmethod
    def unlearnt(cls, cameras: int, alone: bool = True) -> Likelihood:
        """Return normal noise as the background models have it, evenly spread colours, and no bonus."""
        misfit = (np.arange(QUARTERS) + 0.5) / 4
        normal = np.tile((-misfit - 1.5 * np.log(2 * np.pi)).astype(np.float32), (cameras, 1))
        shadow = (ALONE if alone else ASKED) + (np.arange(CLASSES) + 0.5) * (SHADED / CLASSES)
        return cls(normal, color_density(np.zeros(LEVELS**3)), shadow, np.zeros(SIZES), np.ones(cameras))

    @classmethod
    def of(cls, counts: Counts) -> Likelihood:
        """Calibrate on counts; what wasn't met keeps its value unlearnt."""
        first = cls.unlearnt(len(counts.misfits))
        background = [
            misfit_density(n) if n.sum() > 0 else b for n, b in zip(counts.misfits, first.background, strict=True)
        ]
        shadow = shadow_odds(counts.shaded) if counts.shaded.any() else first.shadow
        behind, before = counts.confirmed
        worth = np.maximum.accumulate(np.log((before + 1) / (behind + 1)).clip(0, SURE))
        alike = np.where(counts.alike[:, 1] > 0, counts.alike[:, 0] / np.maximum(counts.alike[:, 1], 1), 1.0)
        return cls(np.array(background, np.float32), color_density(counts.colors), shadow, worth, alike)


def size_class(size: np.ndarray) -> np.ndarray:
    """Class of the size of what the other cameras confirm, voxels."""
    return np.asarray(np.clip(np.floor(_octaves(size)) + 2, 0, SIZES - 1).astype(np.int64))


def _octaves(size: np.ndarray) -> np.ndarray:
    return np.asarray(np.log2(np.maximum(size, 0.25)))


def shadow_odds(counts: np.ndarray) -> np.ndarray:
    """Log odds of a pixel that fits a shadow by its misfit, (CLASSES,) float, from counts as in `Counts.shaded`.

    They can only rise with the misfit, and are infinite if there are (nearly) no shadows.
    """
    (*behind, all_behind), (*subject, all_subject) = counts
    if sum(behind) < LEAST_SHADOWS * all_behind:
        return np.full(CLASSES, np.inf)
    front = np.log((np.array(subject) + 1) / (all_subject + CLASSES))
    back = np.log((np.array(behind) + 1) / (all_behind + CLASSES))
    return np.maximum.accumulate(front - back)


def misfit_density(counts: np.ndarray) -> np.ndarray:
    """Log density of a colour of the background by its misfit D, (QUARTERS,) float32.

    What lies between two misfits in colour space is a shell of the volume 4 π σ³ √(2 D) dD. The counts divided by it
    are the density, whatever the noise is like, but for the last shell, which has no end; it can only fall with D.

    Parameters
    ----------
    counts : (K,) float
        Pixels of certain background by class of misfit.
    """
    counts = counts + 0.5
    middle = np.maximum(0.5 * (BINS[1:] + BINS[:-1]), 0.1)
    density = counts / counts.sum() / np.diff(BINS) / (4 * np.pi * np.sqrt(2 * middle))
    density = np.minimum.accumulate(density)
    quarter = np.searchsorted(BINS, np.arange(QUARTERS) / 4, side="right") - 1
    return np.log(density[np.minimum(quarter, len(density) - 1)]).astype(np.float32)


def count_misfits(misfit: np.ndarray, certain: np.ndarray) -> np.ndarray:
    """Count misfits (H, W) of certain background by class, (K,) float."""
    return np.histogram(misfit[certain].clip(0, BINS[-1] - 0.01), BINS)[0].astype(float)


def count_shaded(shade: np.ndarray, fits: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Count the pixels that fit a shadow by class of its misfit (H, W), then those they are among: (CLASSES + 1,)."""
    classes = np.histogram(shade[fits], CLASSES, (0, SHADED))[0]
    return np.append(classes, np.count_nonzero(among)).astype(float)


def log_odds(
    image: np.ndarray,
    model: BackgroundModel,
    misfit: np.ndarray,
    shade: np.ndarray,
    likelihood: Likelihood,
    camera: int,
) -> np.ndarray:
    """Log likelihood ratio subject : background of each pixel, limited to ±SURE; UNKNOWN where there is no background.

    What a shadow explains has at most the odds at which subject and background fit shadows as well; they
    fall with the texture that is seen through it.

    Parameters
    ----------
    image : (H, W, 3) uint8
    model : BackgroundModel
    misfit, shade : (H, W) float32
        Half the chi-square against the background and against its shadow.
    likelihood : Likelihood
    camera : int

    Returns
    -------
    (H, W) float32
    """
    return _log_odds(
        image,
        model.log_sigma,
        model.known,
        model.texture,
        misfit,
        shade,
        likelihood.subject,
        likelihood.background[camera],
        likelihood.shadow,
        LEVEL,
        LEAST,
    )


LEAST = float(np.log(OUTLIER / 256.0**3))


@njit(cache=True, nogil=True, error_model="numpy")
def _log_odds(image, log_sigma, known, texture, misfit, shade, subject, background, shadow, level, least):
    out = np.empty(known.shape, np.float32)
    for y in range(known.shape[0]):
        for x in range(known.shape[1]):
            if not known[y, x]:
                out[y, x] = UNKNOWN
                continue
            tight = 3.0 * log_sigma[y, x]
            b = max(background[min(QUARTERS - 1, int(4 * min(misfit[y, x], 1e6)))] - tight, least)
            f = subject[level[image[y, x, 0]], level[image[y, x, 1]], level[image[y, x, 2]]]
            odds = f - b
            if shade[y, x] < SHADED:
                fit = shadow[int(shade[y, x] * (CLASSES / SHADED))]
                odds = min(odds, fit - 0.5 * TEXTURE_SAMPLES * np.log1p(texture[y, x]))
            out[y, x] = min(max(odds, -SURE), SURE)
    return out


def shared_noise(odds: np.ndarray, certain: np.ndarray, reach: int = 4) -> float:
    """Measure how many neighbouring pixels of certain background fraction their noise.

    The sum of the correlations of the log odds over all neighbours, as a product of rows' and columns'. Sums over
    regions are worth that much less than if each pixel had noise of its own (compressed video).

    Parameters
    ----------
    odds : (H, W) float32
    certain : (H, W) bool
    reach : int
        Farthest neighbour, pixels.

    Returns
    -------
    float
        At least 1.
    """
    if np.count_nonzero(certain) < 1000:
        return 1.0
    g = np.where(certain, odds - odds[certain].mean(), np.float32(0.0))
    result = 1.0
    for a, n in ((g[::4], certain[::4]), (g[:, ::4].T, certain[:, ::4].T)):
        variance = float((a * a).sum()) / max(1, int(np.count_nonzero(n)))
        total = 1.0
        for k in range(1, reach + 1):
            pairs = np.count_nonzero(n[:, k:] & n[:, :-k])
            if pairs and variance > 0:
                total += 2.0 * max(0.0, float((a[:, k:] * a[:, :-k]).sum()) / pairs / variance)
        result *= total
    return result
