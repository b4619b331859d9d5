"""Epipolar geometry of pinhole images, as the matching kernels use it.

A template pixel x̃ = (x, y, 1) at inverse depth μ = 1/Z along the template camera's axis is seen in search camera i at

    π_i(μ) ∝ K_i R_i R_tᵀ K_t⁻¹ x̃ + μ K_i (t_i − R_i R_tᵀ t_t),

a straight line that μ runs through. The first nine numbers of a transfer are the matrix, row by row, the last three the
vector; both are written for array indices (COLMAP pixel minus 0.5), which is what the kernels work in.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig

_INDEX_FROM_PIXEL = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
_PIXEL_FROM_INDEX = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])


def transfers(rig: Rig, template: int, searches: Sequence[int]) -> np.ndarray:
    """Return the epipolar geometry of a template camera and its search cameras.

    Parameters
    ----------
    rig : Rig
        Pinhole cameras (`Rig.undistorted`).
    template : int
    searches : sequence of K int

    Returns
    -------
    transfers : (K, 12) float
        Matrix and vector as in the module's text, for array indices.

    Raises
    ------
    CalibrationError
        If a camera has lens distortion.
    """
    if not rig.is_pinhole:
        raise CalibrationError("epipolar lines are straight only without lens distortion: use Rig.undistorted()")
    K = np.array([c.calibration_matrix() for c in rig.cameras])
    R, t = rig.cam_from_world[:, :, :3], rig.cam_from_world[:, :, 3]
    result = np.empty((len(searches), 12))
    for k, i in enumerate(searches):
        relative = R[i] @ R[template].T
        A = _INDEX_FROM_PIXEL @ K[i] @ relative @ np.linalg.inv(K[template]) @ _PIXEL_FROM_INDEX
        b = _INDEX_FROM_PIXEL @ K[i] @ (t[i] - relative @ t[template])
        result[k] = [*A.ravel(), *b]
    return result
