"""How much of what each camera takes for the subject can be there for the others: rays of few pixels, no volume.

A pixel of a silhouette is explained if some point on its ray lies in the silhouettes of all other cameras, or where
they can't see. Silhouettes of one subject, taken at one time by rightly calibrated cameras, are explained wholly,
whatever its shape: what is left over is contradiction.

References
----------
Laurentini, The visual hull concept for silhouette-based image understanding, PAMI 16(2), 1994.
Matusik, Buehler, Raskar, McMillan & Gortler, Image-based visual hulls, SIGGRAPH 2000 (rays in place of a volume).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.subject_bounds import focus

PIXELS = 160  # of a silhouette, that are asked
MOST_STEPS = 600  # on a ray


def unexplained(views: PinholeViews, heeded: np.ndarray | None = None, blind: np.ndarray | None = None) -> np.ndarray:
    """Share of each silhouette that the other cameras deny, (C,) float; NaN for cameras not asked or without one.

    A camera denies a point within its image but further than a pixel from its silhouette, and one outside of its image
    unless that cuts the silhouette off. A camera without a silhouette, or with specks only, denies nothing. Cameras in
    one place see along the same rays and are not asked.

    Parameters
    ----------
    views : PinholeViews
        Small images do, and pixels are its tolerance.
    heeded : (C,) bool, optional
        Cameras that are asked; all by default.
    blind : (C,) bool, optional
        Cameras that have no say because they see nothing of the subject; told from the silhouettes by default.
    """
    blind = views.blind() if blind is None else blind
    heeded = ~blind if heeded is None else heeded & ~blind
    empty = views.masks.reshape(len(views), -1).max(axis=1) == 0
    inverse = np.linalg.inv(views.projections[:, :, :3])
    centers = -np.einsum("cij,cj->ci", inverse, views.projections[:, :, 3])
    away = np.linalg.norm(centers - focus(views)[0], axis=1)
    reach = float(np.median(away))
    pixel = away / np.linalg.norm(views.projections[:, 0, :3], axis=1)  # what one is wide at the subject, metres
    step = max(float(pixel.min()), 2 * reach / MOST_STEPS)
    unseen = views.cut_off() | empty
    result = np.full(len(views), np.nan)
    if step <= 0:
        return result
    for c in np.flatnonzero(heeded & ~empty):
        v, u = np.nonzero(views.masks[c])
        chosen = np.unique(np.linspace(0, len(u) - 1, min(PIXELS, len(u))).round().astype(int))
        rays = np.column_stack([u[chosen] + 0.5, v[chosen] + 0.5, np.ones(len(chosen))]) @ inverse[c].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        others = heeded.copy()
        others[c] = False
        denied = denied_rays(
            views.projections[others],
            views.masks[others],
            views.valid[others],
            unseen[others],
            centers[c],
            rays,
            np.tile([max(away[c] - reach, 0.0), away[c] + reach], (len(rays), 1)),
            step,
            1,
            0,
        )
        result[c] = denied.mean()
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def denied_rays(P, masks, valid, unseen, origin, rays, spans, step, slack, least):
    """Tell which rays have no point that all cameras agree to, (N,) bool.

    Parameters
    ----------
    P : (C, 3, 4) float
    masks, valid : (C, H, W) uint8
    unseen : (C,) bool
        Whether a camera agrees to what is outside of its image.
    origin : (3,) float
    rays : (N, 3) float
    spans : (N, 2) float
        First and last distance on each ray at which to ask.
    step : float
        From there to the next; the first point is half of it behind the first distance.
    slack : int
        Pixels along and across by which a point may miss a silhouette.
    least : int
        Cameras within whose images a point must be.
    """
    C, H, W = masks.shape
    result = np.ones(rays.shape[0], np.bool_)
    for r in range(rays.shape[0]):
        first = 0
        for k in range(math.ceil((spans[r, 1] - spans[r, 0]) / step)):
            t = spans[r, 0] + (k + 0.5) * step
            x, y, z = origin[0] + t * rays[r, 0], origin[1] + t * rays[r, 1], origin[2] + t * rays[r, 2]
            agreed, within = True, 0
            for n in range(C):
                c = (first + n) % C  # who denied the point before will deny this one
                says = unseen[c]
                w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
                if w > 0:
                    a = (P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 2] * z + P[c, 0, 3]) / w
                    b = (P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 2] * z + P[c, 1, 3]) / w
                    if 0 <= a < W and 0 <= b < H and valid[c, int(b), int(a)]:
                        says = False
                        within += 1
                        for j in range(max(int(b) - slack, 0), min(int(b) + slack + 1, H)):
                            for i in range(max(int(a) - slack, 0), min(int(a) + slack + 1, W)):
                                says |= masks[c, j, i] > 0
                if not says:
                    agreed = False
                    first = c
                    break
            if agreed and within >= least:
                result[r] = False
                break
    return result
