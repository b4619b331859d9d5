"""Colours that recur at a pixel, together with what is around it: the background of a recording without an empty frame.

Where the subject is most of the time, its own colour, of evenly coloured skin or cloth, is often that which most frames
agree on. But it moves, and what is around a pixel moves with it: whole windows come back as they were only where the
background is seen again.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

WINDOW = 3  # pixels from its middle to its sides
# Of a window's pixels. Two frames with independent normal noise differ by less than 3 sigma in all three channels at
# 0.9 of them; neither this nor the window's size was tried with other values.
ALIKE = 0.75
_BAND = 32  # rows that are worked on at once
_F4 = np.float32


@njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def recurrences(stack, gains, offsets, reach, radius, alike):
    """Count in how many frames each pixel of a frame comes back with the window around it.

    Parameters
    ----------
    stack : (T, H, W, 3) uint8
    gains, offsets : (T, 3) float32
        Light of each frame, frame = gain · background + offset.
    reach : (H, W) float32
        Colours within this distance in every channel agree, grey levels.
    radius : int
        Of the windows, pixels.
    alike : float
        Fraction of a window's pixels within the image that must agree.

    Returns
    -------
    (T, H, W) uint16
        Frames, itself included.
    """
    T, H, W = stack.shape[0], stack.shape[1], stack.shape[2]
    counts = np.ones((T, H, W), np.uint16)
    for band in prange((H + _BAND - 1) // _BAND):
        first, last = band * _BAND, min((band + 1) * _BAND, H)
        top, bottom = max(first - radius, 0), min(last + radius, H)
        lit = np.empty((T, bottom - top, W, 3), np.float32)
        for t in range(T):
            for y in range(top, bottom):
                for x in range(W):
                    for c in range(3):
                        lit[t, y - top, x, c] = (_F4(stack[t, y, x, c]) - offsets[t, c]) / gains[t, c]
        agree = np.zeros(W + 2 * radius + 1, np.int32)  # between borders of zeros
        along = np.zeros((bottom - top, W), np.int32)
        window = np.empty(W, np.int32)
        for t in range(T):
            for u in range(t + 1, T):
                for y in range(bottom - top):
                    for x in range(W):
                        a = abs(lit[t, y, x, 0] - lit[u, y, x, 0])
                        b = abs(lit[t, y, x, 1] - lit[u, y, x, 1])
                        c = abs(lit[t, y, x, 2] - lit[u, y, x, 2])
                        agree[x + radius + 1] = max(a, max(b, c)) <= reach[y + top, x]
                    some = np.int32(0)
                    for x in range(W + radius):
                        some += agree[x + radius + 1]
                        if x >= radius:
                            along[y, x - radius] = some
                            some -= agree[x - radius + 1]
                for y in range(first, last):
                    low, high = max(y - radius, 0), min(y + radius, H - 1)
                    for x in range(W):
                        window[x] = 0
                    for v in range(low, high + 1):
                        for x in range(W):
                            window[x] += along[v - top, x]
                    for x in range(W):
                        wide = min(x + radius, W - 1) - max(x - radius, 0) + 1
                        if window[x] >= alike * (wide * (high - low + 1)):
                            counts[t, y, x] += 1
                            counts[u, y, x] += 1
    return counts
