"""Cameras round a subject made of ellipsoids, with exact silhouettes: what tests and benchmarks of carving need."""

from __future__ import annotations

import numpy as np

# centres and radii, metres: trunk, head, arms, legs, feet of a walking figure
FIGURE = np.array(
    [
        [0.00, 0.00, 1.20, 0.20, 0.13, 0.33],
        [0.00, 0.02, 1.66, 0.09, 0.11, 0.13],
        [0.28, 0.10, 1.25, 0.07, 0.08, 0.20],
        [0.32, 0.28, 1.02, 0.05, 0.18, 0.06],
        [-0.28, -0.08, 1.22, 0.07, 0.08, 0.20],
        [-0.33, -0.05, 0.92, 0.05, 0.06, 0.18],
        [0.10, 0.10, 0.72, 0.09, 0.11, 0.25],
        [0.11, 0.12, 0.30, 0.06, 0.07, 0.25],
        [0.11, 0.20, 0.06, 0.05, 0.13, 0.05],
        [-0.11, -0.10, 0.72, 0.09, 0.11, 0.25],
        [-0.12, -0.24, 0.32, 0.06, 0.09, 0.25],
        [-0.12, -0.22, 0.06, 0.05, 0.12, 0.05],
    ]
)


def look_at(center, target, focal: float, width: int, height: int) -> np.ndarray:
    """Projection (3, 4) of a camera at `center` that has `target` in the middle of its picture, world z up."""
    center, target = np.asarray(center, float), np.asarray(target, float)
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.0, 0.0, -1.0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return K @ np.column_stack([R, -R @ center])


def ring(
    count: int, *, radius=3.2, target=(0, 0, 0.9), arc_deg=360.0, focal=300.0, width=320, height=240
) -> np.ndarray:
    """Projections (C, 3, 4) of cameras on an arc round `target`, alternately lower and higher."""
    steps = count if arc_deg >= 360 else count - 1
    angles = np.deg2rad(arc_deg) * np.arange(count) / max(steps, 1)
    target = np.asarray(target, float)
    return np.array(
        [
            look_at(
                target + radius * np.array([np.cos(a), np.sin(a), 0.15 * (1 + i % 2)]),
                target,
                focal,
                width,
                height,
            )
            for i, a in enumerate(angles)
        ]
    )


def silhouettes(P: np.ndarray, ellipsoids: np.ndarray, width=320, height=240) -> list[np.ndarray]:
    """Exact silhouettes (H, W) uint8 of ellipsoids (N, 6: centre, radii) in cameras P, by their outline conics."""
    v, u = np.mgrid[0:height, 0:width] + 0.5
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    masks = []
    for camera in P:
        mask = np.zeros((height, width), bool)
        for *center, a, b, c in np.atleast_2d(ellipsoids):
            place = np.eye(4)
            place[:3, 3] = center
            dual = camera @ place @ np.diag([a * a, b * b, c * c, -1.0]) @ place.T @ camera.T
            conic = np.linalg.inv(dual)
            middle = dual[:, 2] / dual[2, 2]
            value = np.einsum("hwi,ij,hwj->hw", pixels, conic, pixels)
            mask |= value * (middle @ conic @ middle) > 0
        masks.append(mask.astype(np.uint8))
    return masks
