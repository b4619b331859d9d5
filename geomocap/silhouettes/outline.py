"""The silhouette's outline: half-covered pixels decided by mixing subject and background colours."""

from __future__ import annotations

import numpy as np
from numba import njit

REACH = 3  # pixels from which the colours on either side are taken
CONTRAST = 3.0  # least difference of the two colours, in standard deviations of the subject's


@njit(cache=True, nogil=True, error_model="numpy")
def refine_outline(mask, image, mean, known, sigma, gain, offset):
    """Decide the pixels on both sides of the outline by the subject's fraction of their colour.

    A pixel on the outline mixes the subject's colour F and the background's B, I = a F + (1 - a) B. B is known (shaded
    as the background pixels beside it), F is the mean of the subject's pixels nearby that aren't on the outline
    themselves. The pixel belongs to the subject if a >= 1/2. Where F varies too much to tell it from B, the pixel stays
    as it is.

    Parameters
    ----------
    mask : (H, W) bool
    image : (H, W, 3) uint8
    mean, known, sigma, gain, offset
        As in `background_misfit`.

    Returns
    -------
    (H, W) bool
    """
    h, w = mask.shape
    rim = np.zeros((h, w), np.bool_)
    for y in range(h):
        for x in range(w):
            m = mask[y, x]
            rim[y, x] = (
                (x > 0 and mask[y, x - 1] != m)
                or (x + 1 < w and mask[y, x + 1] != m)
                or (y > 0 and mask[y - 1, x] != m)
                or (y + 1 < h and mask[y + 1, x] != m)
            )
    result = mask.copy()
    front, back = np.empty(3), np.empty(3)
    for y in range(h):
        for x in range(w):
            if not rim[y, x] or not known[y, x]:
                continue
            front[:] = 0.0
            inside, outside, square = 0.0, 0.0, 0.0
            seen, plain = 0.0, 0.0
            for v in range(max(0, y - REACH), min(h, y + REACH + 1)):
                for u in range(max(0, x - REACH), min(w, x + REACH + 1)):
                    if rim[v, u]:
                        continue
                    weight = 1.0 / ((v - y) ** 2 + (u - x) ** 2)
                    if mask[v, u]:
                        inside += weight
                        for c in range(3):
                            front[c] += weight * image[v, u, c]
                            square += weight * np.float64(image[v, u, c]) ** 2
                    elif known[v, u]:
                        outside += weight
                        for c in range(3):
                            seen += weight * image[v, u, c]
                            plain += weight * (gain[c] * mean[v, u, c] + offset[c])
            if inside == 0.0:
                continue
            shade = min(max(seen / plain, 0.2), 1.5) if outside > 0.0 and plain > 0.0 else 1.0
            step, fraction, spread = 0.0, 0.0, square / inside
            for c in range(3):
                back[c] = shade * (gain[c] * mean[y, x, c] + offset[c])
                front[c] /= inside
                spread -= front[c] * front[c]
                step += (front[c] - back[c]) ** 2
                fraction += (image[y, x, c] - back[c]) * (front[c] - back[c])
            if step > max((6.0 * sigma[y, x]) ** 2, CONTRAST * CONTRAST * spread):
                result[y, x] = fraction >= 0.5 * step
    return result
