"""Voxels and clouds against the true surface: accuracy and completeness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from geomocap.evaluation.result import Curve, Evaluation
from geomocap.evaluation.truth import Truth
from geomocap.files.frame_files import read_points, read_voxels
from geomocap.files.run import Run

NEAR_MM = 10.0


def judge_surface(run: Run, truth: Truth, kind: Literal["voxels", "cloud"], frames: Sequence[int]) -> Evaluation:
    """Compare a run's voxels or cloud with the true surface.

    Accuracy is the distance of a point from the surface; completeness the distance of a true vertex from the points.
    """
    accuracy, completeness, counts, judged = [], [], [], []
    for k in frames:
        points = read_geometry(run, kind, k)
        if points is None or not len(points):
            continue
        closest = truth.surface(k).closest(points)[0]
        accuracy.append(np.linalg.norm(closest - points, axis=1) * 1000)
        completeness.append(cKDTree(points).query(truth.vertices[k])[0] * 1000)
        counts.append(len(points))
        judged.append(k)
    if not judged:
        return Evaluation({})
    d, c = np.concatenate(accuracy), np.concatenate(completeness)
    figures = {
        f"{kind}.points_per_frame": int(np.mean(counts)),
        f"{kind}.accuracy_median": np.median(d),
        f"{kind}.accuracy_p95": np.percentile(d, 95),
        f"{kind}.completeness_median": np.median(c),
        f"{kind}.fraction_of_surface_within_10mm": float(np.mean(c < NEAR_MM)),
    }
    at = np.array(judged)
    curves = (
        Curve(f"{kind}: median distance of points from the true surface", "mm", at, _each(np.median, accuracy)),
        Curve(f"{kind}: median distance of the true surface from points", "mm", at, _each(np.median, completeness)),
    )
    return Evaluation(figures, curves)


def _each(measure: object, lists: list[np.ndarray]) -> np.ndarray:
    return np.array([measure(x) for x in lists])  # type: ignore[operator]


def read_geometry(run: Run, kind: Literal["voxels", "cloud"], frame: int) -> np.ndarray | None:
    """Return a frame's points, (N, 3) metres, or None if the run doesn't have it."""
    file = run.frame_file(kind, frame)
    if not file.is_file():
        return None
    return read_voxels(file).points if kind == "voxels" else read_points(file).positions
