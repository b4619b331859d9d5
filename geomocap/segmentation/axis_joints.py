"""Joint positions from the ellipsoids of two bodies, by samples that grow along their axes."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(
    x: float, y: float, z: float, centers: np.ndarray, radii: np.ndarray, rotations: np.ndarray, k: int
) -> bool:
    dx, dy, dz = x - centers[k, 0], y - centers[k, 1], z - centers[k, 2]
    f = 0.0
    for a in range(3):
        u = (rotations[k, 0, a] * dx + rotations[k, 1, a] * dy + rotations[k, 2, a] * dz) / radii[k, a]
        f += u * u
    return f <= 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def grow_joints(
    centers: np.ndarray, radii: np.ndarray, rotations: np.ndarray, pairs: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Joints between pairs of bodies, frame by frame (section 8).

    Samples stand at equal steps on the three axes of both ellipsoids. Going outward from both centres at once, the
    first step at which samples of one lie inside the other gives the joint, the mean of these samples. If no sample up
    to the surfaces does, because the ellipsoids don't overlap, the joint is halfway between the two surfaces on the
    line through the centres.

    Parameters
    ----------
    centers : (T, B, 3) float, metres
    radii : (T, B, 3) float, metres
    rotations : (T, B, 3, 3) float
        Columns are the axes.
    pairs : (J, 2) int
        Bodies of each joint.
    step : float, metres

    Returns
    -------
    positions : (T, J, 3) float, metres
    overlapping : (T, J) bool
        False where the joint is only halfway between the surfaces.
    """
    frames, count = centers.shape[0], pairs.shape[0]
    positions = np.empty((frames, count, 3))
    overlapping = np.ones((frames, count), np.bool_)
    for t in range(frames):
        c, r, v = centers[t], radii[t], rotations[t]
        for j in range(count):
            most = max(r[pairs[j, 0]].max(), r[pairs[j, 1]].max())
            hits = 0
            sx = sy = sz = 0.0
            for n in range(int(most / step) + 1):
                s = n * step
                for side in range(2):
                    k, other = pairs[j, side], pairs[j, 1 - side]
                    for a in range(3):
                        if s > r[k, a]:
                            continue
                        for sign in (-1.0, 1.0):
                            x = c[k, 0] + sign * s * v[k, 0, a]
                            y = c[k, 1] + sign * s * v[k, 1, a]
                            z = c[k, 2] + sign * s * v[k, 2, a]
                            if _inside(x, y, z, c, r, v, other):
                                hits += 1
                                sx += x
                                sy += y
                                sz += z
                if hits > 0:
                    break
            if hits > 0:
                positions[t, j, 0] = sx / hits
                positions[t, j, 1] = sy / hits
                positions[t, j, 2] = sz / hits
                continue
            overlapping[t, j] = False
            a, b = pairs[j, 0], pairs[j, 1]
            fa = fb = 0.0
            for axis in range(3):
                u = 0.0
                for i in range(3):
                    u += v[a, i, axis] * (c[b, i] - c[a, i])
                fa += (u / r[a, axis]) ** 2
                u = 0.0
                for i in range(3):
                    u += v[b, i, axis] * (c[b, i] - c[a, i])
                fb += (u / r[b, axis]) ** 2
            # surfaces on the line from a (0) to b (1)
            along = 0.5 * (1.0 / np.sqrt(max(fa, 1e-12)) + 1.0 - 1.0 / np.sqrt(max(fb, 1e-12)))
            along = min(max(along, 0.0), 1.0)
            for i in range(3):
                positions[t, j, i] = c[a, i] + along * (c[b, i] - c[a, i])
    return positions, overlapping
