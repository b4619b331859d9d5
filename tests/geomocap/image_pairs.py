"""Patches of one image matched in another, each for itself; and where a plane's points are seen, written plainly."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from geomocap.matching.lsm import Matches, match_multi
from geomocap.matching.matching_settings import KernelSettings
from geomocap.matching.spline import ImageStack


def pair(template: np.ndarray, search: np.ndarray, order: int = 3, mask: np.ndarray | None = None) -> ImageStack:
    """Two grey images ready for matching; `mask`: where the template may be used."""
    return ImageStack.of([template, search], order, [mask, None])


def match_pairs(
    images: ImageStack, points: np.ndarray, start: np.ndarray, settings: KernelSettings | None = None
) -> Matches:
    """Match patches of the first image around points (N, 2) in the second, from (N, 2) or (N, 6) on."""
    found = match_multi(images, 0, [1], points, np.asarray(start, float)[:, None], None, settings)
    return Matches(*(getattr(found, field.name)[:, 0] for field in fields(found)))


def deviations(matches: Matches) -> np.ndarray:
    """Standard deviations of the positions in x and y, (…, 2), pixels."""
    return np.sqrt(np.diagonal(matches.covariance, axis1=-2, axis2=-1))


def seen_at(transfers: np.ndarray, pixels: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    """Where template pixels (N, 2) at inverse depths (N,) are seen in K search images: (N, K, 2), COLMAP pixels."""
    p = _projected(transfers, pixels, inverse_depth)
    return np.where(p[..., 2:] > 1e-9, p[..., :2] / p[..., 2:], np.nan) + 0.5


def plane_affine(transfers: np.ndarray, pixels: np.ndarray, inverse_depth: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Affine matrices (N, K, 2, 2) of small patches on planes: of π(x, μ(x)) the derivative, μ linear in the image."""
    p = _projected(transfers, pixels, inverse_depth)
    A, b = transfers[:, :9].reshape(-1, 3, 3), transfers[:, 9:]
    gradient = A[None, :, :, :2] + b[None, :, :, None] * np.asarray(slope)[:, None, None, :]
    return (gradient[..., :2, :] - p[..., :2, None] / p[..., 2:, None] * gradient[..., 2:, :]) / p[..., 2:, None]


def _projected(transfers: np.ndarray, pixels: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    x = np.column_stack([np.asarray(pixels, float) - 0.5, np.ones(len(pixels))])
    A, b = transfers[:, :9].reshape(-1, 3, 3), transfers[:, 9:]
    return np.einsum("kij,nj->nki", A, x) + np.asarray(inverse_depth)[:, None, None] * b
