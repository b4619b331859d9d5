"""Images of another size than their camera was calibrated for: how the one became the other, and the camera for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap

SizeMismatch = Literal["auto", "crop-right", "center", "scale", "letterbox"]
"""How an image was made from the calibrated one: cut off at the right and below; cut (or padded) about its centre;
stretched to the new size; scaled by one factor and padded with black bars; or to be found out."""

AGREEMENT = 1.5  # pixels within which a feature agrees
BAR_LEVEL = 24  # grey levels that black bars stay below


@dataclass(frozen=True)
class ImageFit:
    """Pixels of the image from pixels of the calibrated one: u = scale · u_calibrated + shift.

    Attributes
    ----------
    scale, shift : (2,) float
        For COLMAP pixels, x and y.
    """

    scale: np.ndarray
    shift: np.ndarray

    def apply(self, pixels: np.ndarray) -> np.ndarray:
        """Map pixels (N, 2) of the calibrated image to pixels of the image."""
        return pixels * self.scale + self.shift


def possible_fits(calibrated: tuple[int, int], actual: tuple[int, int]) -> dict[str, ImageFit]:
    """All ways in which an image of one (width, height) may have become one of another."""
    before, after = np.array(calibrated, dtype=float), np.array(actual, dtype=float)
    one, zero = np.ones(2), np.zeros(2)
    uniform = float((after / before).min())
    return {
        "crop-right": ImageFit(one, zero),
        "center": ImageFit(one, np.floor((after - before) / 2)),
        "scale": ImageFit(after / before, zero),
        "letterbox": ImageFit(uniform * one, (after - uniform * before) / 2),
    }


def refit_camera(camera: pycolmap.Camera, fit: ImageFit, size: tuple[int, int]) -> pycolmap.Camera:
    """Return the camera that takes the image as it is now.

    Raises
    ------
    CalibrationError
        If the image was stretched and the camera's model has but one focal length.
    """
    params = np.array(camera.params, dtype=float)
    focal, center = list(camera.focal_length_idxs()), list(camera.principal_point_idxs())
    if len(focal) == 1 and abs(fit.scale[0] - fit.scale[1]) > 1e-9:
        raise CalibrationError(
            f"a {camera.model.name} camera can't be stretched by {fit.scale[0]:.4f} and {fit.scale[1]:.4f}; "
            "convert it to OPENCV"
        )
    params[focal] *= fit.scale[: len(focal)]
    params[center] = fit.apply(params[center])
    return pycolmap.Camera(model=camera.model.name, width=size[0], height=size[1], params=params.tolist())


def measure_fits(image: np.ndarray, reference: np.ndarray, fits: dict[str, ImageFit]) -> tuple[dict[str, float], int]:
    """Compare an image with a picture of the same view in the calibrated size.

    Features are matched between the two (SIFT, D. Lowe 2004); each way in which the one may have become the other
    gets the fraction of the matches that it explains to 1.5 pixels.

    Parameters
    ----------
    image, reference : (H, W, 3) uint8

    Returns
    -------
    fractions : dict of str to float
        0 … 1.
    matches : int
    """
    sift = cv2.SIFT_create(4000)  # type: ignore[attr-defined]
    points, descriptors = [], []
    for picture in (image, reference):
        found, described = sift.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None)
        points.append(np.array([p.pt for p in found]).reshape(-1, 2) + 0.5)
        descriptors.append(described)
    if min(len(p) for p in points) < 2:
        return dict.fromkeys(fits, 0.0), 0
    pairs = [p for p in cv2.BFMatcher().knnMatch(descriptors[0], descriptors[1], k=2) if len(p) == 2]
    good = [a for a, b in pairs if a.distance < 0.7 * b.distance]
    seen, expected = points[0][[m.queryIdx for m in good]], points[1][[m.trainIdx for m in good]]
    fractions = {}
    for name, fit in fits.items():
        off = np.linalg.norm(fit.apply(expected) - seen, axis=1)
        fractions[name] = float(np.mean(off < AGREEMENT)) if len(good) else 0.0
    return fractions, len(good)


def has_black_bars(image: np.ndarray, fit: ImageFit) -> bool:
    """Whether the image (H, W, 3) is black where a padded image would be, and not just inside."""
    dark = image.max(axis=2) < BAR_LEVEL
    x, y = (int(s) for s in np.floor(fit.shift + 0.5))
    bars, inside = [], []
    if y >= 2:
        bars += [dark[: y - 1], dark[len(dark) - y + 1 :]]
        inside += [dark[y + 1 : 2 * y + 8], dark[len(dark) - 2 * y - 8 : len(dark) - y - 1]]
    if x >= 2:
        bars += [dark[:, : x - 1], dark[:, dark.shape[1] - x + 1 :]]
        inside += [dark[:, x + 1 : 2 * x + 8], dark[:, dark.shape[1] - 2 * x - 8 : dark.shape[1] - x - 1]]
    return bool(bars) and all(b.mean() > 0.97 for b in bars) and all(i.mean() < 0.7 for i in inside)


def find_fit(
    image: np.ndarray, reference: np.ndarray | None, calibrated: tuple[int, int], mode: SizeMismatch = "auto"
) -> tuple[str, ImageFit, str]:
    """Decide how an image of the wrong size came about.

    Parameters
    ----------
    image : (H, W, 3) uint8
    reference : (H', W', 3) uint8, optional
        A picture of the same view; used if it has the calibrated size.
    calibrated : (int, int)
        Width and height that the camera was calibrated for.
    mode : SizeMismatch

    Returns
    -------
    name : str
    fit : ImageFit
    reason : str
        What speaks for it, for the report.

    Raises
    ------
    CalibrationError
        If a reference was compared and nothing explains it.
    """
    actual = (image.shape[1], image.shape[0])
    fits = possible_fits(calibrated, actual)
    if mode != "auto":
        return mode, fits[mode], "as asked for"
    if reference is not None and (reference.shape[1], reference.shape[0]) == tuple(calibrated):
        fractions, matches = measure_fits(image, reference, fits)
        best = max(fractions, key=lambda n: fractions[n])
        listed = ", ".join(f"{n} {100 * s:.0f} %" for n, s in fractions.items())
        if matches >= 30 and fractions[best] >= 0.4:
            return best, fits[best], f"explains {100 * fractions[best]:.0f} % of {matches} features ({listed})"
        if matches >= 30:
            raise CalibrationError(
                f"nothing explains how an image of {actual[0]}×{actual[1]} came from the calibrated "
                f"{calibrated[0]}×{calibrated[1]} ({listed} of {matches} features); calibrate again"
            )
    if has_black_bars(image, fits["letterbox"]):
        return "letterbox", fits["letterbox"], "it has black bars of the width that this leaves"
    if abs(actual[0] / calibrated[0] / (actual[1] / calibrated[1]) - 1) < 2e-3:
        return "scale", fits["scale"], "the shape is the same; not verified"
    return "crop-right", fits["crop-right"], "a guess without evidence: check it, and give size_mismatch if it is wrong"
