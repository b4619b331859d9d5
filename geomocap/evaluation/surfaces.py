"""Voxels and clouds against the true surface: accuracy and completeness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from geomocap.evaluation.result import Curve, Evaluation, EvaluationError
from geomocap.evaluation.truth import Truth
from geomocap.files.open3d_geometry import read_by_open3d
from geomocap.files.run import Run
from geomocap.model.frame_geometry import Voxels

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
    if kind == "voxels":
        return Voxels.read(file).points
    return read_labelled(run, kind, frame)[0]


def read_labelled(run: Run, kind: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame's points, (N, 3) metres, and their bodies, (N,) int, -1 where there are none."""
    file = run.frame_file(kind, frame)
    cloud = read_by_open3d(o3d.t.io.read_point_cloud, file)
    if "positions" not in cloud.point:
        raise EvaluationError(f"{file}: no readable points; delete it and run again")
    points = cloud.point.positions.numpy().astype(float)
    if "body" not in cloud.point:
        return points, np.full(len(points), -1)
    return points, cloud.point["body"].numpy().ravel().astype(int)
