"""Silhouettes of a textured walker with shadows, beside OpenCV's background subtractor."""

from __future__ import annotations

import cv2
import numpy as np

from geomocap.silhouettes.background import model_from_plate
from geomocap.silhouettes.joint_decision import silhouette
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings
from tests.benchmarks.table import Row, measure
from tests.geomocap.test_silhouettes import overlap, scene


def _mog2(plate: np.ndarray, image: np.ndarray) -> np.ndarray:
    subtractor = cv2.createBackgroundSubtractorMOG2(history=20, detectShadows=True)
    for _ in range(5):
        subtractor.apply(plate, learningRate=0.5)
    return subtractor.apply(image, learningRate=0) == 255


def benchmark() -> list[Row]:
    """Time and accuracy at two image sizes."""
    cv2.setNumThreads(1)
    walk = scene(6)
    rows = []
    for scale, goal in ((1, "≤ 5 ms"), (2, "≤ 20 ms")):

        def sized(image: np.ndarray, scale: int = scale) -> np.ndarray:
            return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) if scale > 1 else image

        plate, frames = sized(walk.plate), [sized(f) for f in walk.frames]
        truth = sized(walk.masks[2].astype(np.uint8)) > 0
        settings = SilhouetteSettings()
        model = model_from_plate(plate, frames, settings)
        subtractor = cv2.createBackgroundSubtractorMOG2(history=20, detectShadows=True)
        subtractor.apply(plate, learningRate=1)
        seconds = measure(lambda f=frames[2], m=model, s=settings: silhouette(f, m, s), 30)  # type: ignore[misc]
        other = measure(lambda f=frames[2], b=subtractor: b.apply(f, learningRate=0), 30)  # type: ignore[misc]
        ours, theirs = overlap(silhouette(frames[2], model, settings), truth), overlap(_mog2(plate, frames[2]), truth)
        rows.append(
            Row(
                f"silhouette, {320 * scale}×{240 * scale}, shadows, light drift",
                seconds,
                "OpenCV MOG2 (one thread)",
                other,
                f"{goal}, IoU ≥ 0.95",
                f"IoU {ours:.3f} against {theirs:.3f}",
            )
        )
    return rows
