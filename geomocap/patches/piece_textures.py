"""How much the texture of a patch, turned in its plane, is that of a place on the surface."""

from __future__ import annotations

from functools import cache

import numpy as np

from geomocap.patches.surface_patches import Patches

ANGLES = 24  # in which textures are compared
_PROMISING = 0.6  # least correlation of textures,
_MATCHES, _MATCHES_OF_ANGLE = 100_000, 20_000  # and most pairs of them


def textures_of(patches: Patches) -> np.ndarray:
    """Blurred textures (N, M) of patches as the first camera with a template saw them; its mean where it saw none."""
    slots = patches.slots[np.arange(len(patches)), patches.has.argmax(axis=1)]
    usable = patches.store.usable[slots] != 0
    texture = np.where(usable, patches.store.templates[slots, 0, :, 0], 0.0).astype(float)
    middle = texture.sum(axis=1) / np.maximum(usable.sum(axis=1), 1)
    return np.where(usable, texture, middle[:, None])


def likenesses(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Correlations (A, N, P) of textures (N, M), turned by A angles, with textures (P, M), within the inner disc."""
    radius = patch_radius(first.shape[1])
    still = _normalised(second @ _turning(radius, 0.0).T).T
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    alike = np.empty((ANGLES, len(first), len(second)), np.float32)
    for k, angle in enumerate(angles):
        np.matmul(_normalised(first @ _turning(radius, angle).T), still, out=alike[k])
    return alike


def best_matches(alike: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles, patches and places of the highest correlations in `alike` (A, n, P): not more than `_MATCHES`."""
    kept = []
    for n, of_angle in enumerate(alike):
        flat = of_angle.ravel()
        best = np.flatnonzero(flat > _PROMISING)
        if len(best) > _MATCHES_OF_ANGLE:
            best = best[np.argpartition(-flat[best], _MATCHES_OF_ANGLE)[:_MATCHES_OF_ANGLE]]
        kept.append(n * of_angle.size + np.sort(best))
    best = np.concatenate(kept)
    if len(best) > _MATCHES:
        best = np.sort(best[np.argpartition(-alike.ravel()[best], _MATCHES)[:_MATCHES]])
    k, i, j = np.unravel_index(best, alike.shape)
    return k, i, j


@cache
def _turning(radius: int, angle: float) -> np.ndarray:
    """Weights (n, M) of the M samples of a square for the n of its inner disc once the texture has turned."""
    s, t = (g.ravel() for g in np.meshgrid(*[np.arange(-radius, radius + 1)] * 2))
    disc = s**2 + t**2 <= radius**2
    x = np.cos(angle) * s[disc] + np.sin(angle) * t[disc]
    y = np.cos(angle) * t[disc] - np.sin(angle) * s[disc]
    weights: np.ndarray = np.maximum(1 - np.abs(x[:, None] - s), 0) * np.maximum(1 - np.abs(y[:, None] - t), 0)
    weights.flags.writeable = False  # it is kept
    return weights


def _normalised(textures: np.ndarray) -> np.ndarray:
    centred = (textures - textures.mean(axis=1, keepdims=True)).astype(np.float32)
    return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-6)


def patch_radius(samples: int) -> int:
    """Half the width of a square patch of so many samples."""
    return (round(samples**0.5) - 1) // 2
