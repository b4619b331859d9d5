"""Refinement over all frames beside SciPy's sparse least squares on the same unknowns, and following a model."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from geomocap.model.hierarchy import Hierarchy
from geomocap.skeleton.articulated_adjustment import adjust
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.kinematics import Linkage, body_motion, joint_motion, moved_by
from geomocap.skeleton.motion_smoothness import Smoothness, accelerations
from tests.benchmarks.table import Row, measure
from tests.geomocap.moving_chains import Chain, chain

SIGMA = 0.002
TURN, SHIFT = 0.05, 0.02


def benchmark() -> list[Row]:
    """30 bodies, 60 frames, 1,500 samples for us; 6 bodies, 20 frames, 120 samples for both."""
    rows = []
    large = _problem(chain(30, frames=60, samples=50))
    rows.append(Row("articulated adjustment, 30 bodies, 60 frames, 1,500 samples", measure(lambda: _ours(*large), 3)))
    small = _problem(chain(6, frames=20, samples=20))
    ours, theirs = _ours(*small), _scipy(*small)
    rows.append(
        Row(
            "articulated adjustment, 6 bodies, 20 frames, 120 samples",
            measure(lambda: _ours(*small), 3),
            "scipy least_squares, sparse Jacobian by differences",
            measure(lambda: _scipy(*small), 1, warm_up=False),
            note=f"largest miss {1e3 * _miss(small, ours):.3f} mm, SciPy {1e3 * _miss(small, theirs):.3f} mm",
        )
    )
    return rows


def _problem(scene: Chain):
    """Linkage, disturbed start, skin and observations of a chain."""
    count = len(scene.joints) + 1
    hierarchy = Hierarchy(0, np.array([[b, b + 1] for b in range(count - 1)], np.int32))
    origin = scene.positions[scene.body == 0, 0].mean(axis=0)
    linkage = Linkage(hierarchy, scene.joints, scene.axes, np.zeros(count - 1, bool), origin)
    root = scene.rotations[:, 0] @ origin + scene.translations[:, 0]
    motion = joint_motion(linkage, scene.rotations, root)
    step = np.random.default_rng(0).normal(0, 0.02, (motion.frames, linkage.joint_dof[-1]))
    points = SkinPoints.of_weights(scene.positions[:, 0], np.eye(count)[scene.body])
    return linkage, moved_by(linkage, motion, step), points, scene.positions


def _prior(linkage: Linkage) -> Smoothness:
    return Smoothness(np.full(linkage.body_count, TURN), SHIFT, 1e6)  # plain least squares, as SciPy's


def _ours(linkage, motion, points, positions):
    observations = Observations.of_paths(positions, np.full(positions.shape[:2], SIGMA))
    found = adjust(linkage, motion, points, observations, smoothness=_prior(linkage), cutoff=1e6, rounds=10)
    return found.motion


def _scipy(linkage, motion, points, positions):
    frames, size = motion.frames, int(linkage.joint_dof[-1])
    scale = np.repeat([TURN, SHIFT, TURN], [3, 3, size - 6])

    def residuals(step):
        moved = moved_by(linkage, motion, step.reshape(frames, size))
        placed = body_motion(linkage, moved).carry(points.rest, points.bodies, points.fractions)
        data = (placed - positions.swapaxes(0, 1)) / SIGMA
        return np.concatenate([data.ravel(), (accelerations(linkage, moved) / scale).ravel()])

    per_frame = 3 * len(points)
    pattern = lil_matrix((frames * per_frame + (frames - 2) * size, frames * size), dtype=np.int8)
    for t in range(frames):
        pattern[t * per_frame : (t + 1) * per_frame, t * size : (t + 1) * size] = 1
    for t in range(frames - 2):
        rows = slice(frames * per_frame + t * size, frames * per_frame + (t + 1) * size)
        pattern[rows, t * size : (t + 3) * size] = 1
    found = least_squares(residuals, np.zeros(frames * size), jac_sparsity=pattern, method="trf", max_nfev=10)
    return moved_by(linkage, motion, found.x.reshape(frames, size))


def _miss(problem, motion) -> float:
    linkage, _, points, positions = problem
    placed = body_motion(linkage, motion).carry(points.rest, points.bodies, points.fractions)
    return float(np.linalg.norm(placed - positions.swapaxes(0, 1), axis=2).max())
