"""Lost patches found again in cameras that had not seen them before: the old templates must fit in two of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomocap.patches.frame_views import FrameViews
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.surface_patches import FACING_OTHERS, PatchAlignment, Patches, align, one_template, visible

_FAR_PX = 7.0  # how far from where its companions have it a patch may be found


def reacquire(
    patches: Patches,
    lost: np.ndarray,
    view: FrameViews,
    slack: np.ndarray,
    settings: TrackingSettings,
    least_correlation: float,
) -> tuple[PatchAlignment, np.ndarray, np.ndarray]:
    """Look for lost patches in all cameras that should see them, with one template for all cameras.

    A patch that has turned away from the cameras that have templates of it comes to be seen by others. It is the same
    piece of surface if what the camera that faces it best remembers fits there in at least two cameras, as it does for
    a new patch.

    Parameters
    ----------
    patches : Patches
        Where their companions have them.
    lost : (N,) bool
    view : FrameViews
    slack : (N, 1) float, metres
        Depth by which something must lie before a patch to hide it.
    settings : TrackingSettings
    least_correlation : float
        From which a patch counts as found, on average of the cameras that agree.

    Returns
    -------
    PatchAlignment
    found : (N,) bool
    agree : (N, C) bool
        Cameras in which it was found.
    """
    use = visible(patches.positions, patches.frames, patches.hidden, view, slack, FACING_OTHERS)
    which = np.flatnonzero(lost & (use.sum(axis=1) >= settings.n_views) & patches.has.any(axis=1))
    some, seen = patches.select(which), use[which]
    rows, C = np.arange(len(which)), view.count
    shared, best = one_template(some, view)
    result = align(
        shared,
        rows,
        some.positions,
        some.frames,
        seen,
        view,
        iterations=(6, 10),
        least_correlation=settings.camera_correlation,
        prior_shift_px=_FAR_PX,
        prior_turn=0.2,
    )
    variance = result.sigma**2 + some.doubt[rows, best] ** 2
    result = replace(result, sigma=np.sqrt(variance), image_sigma=np.sqrt(variance))
    agree = seen & (result.by_camera >= settings.camera_correlation)
    fits = (agree.sum(axis=1) >= settings.n_views) & (result.correlation >= least_correlation)
    fits &= (result.sigma < settings.sigma_px * some.size) & view.may_be_subject(result.positions)
    fits &= np.linalg.norm(result.positions - some.positions, axis=1) < _FAR_PX * some.size
    N = len(patches)
    found, cameras = np.zeros(N, bool), np.zeros((N, C), bool)
    found[which[fits]] = True
    cameras[which[fits]] = agree[fits]
    return result.spread(which, patches.positions, patches.frames), found, cameras
