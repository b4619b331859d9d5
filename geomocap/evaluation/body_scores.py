"""Found bodies against the true ones: the adjusted Rand index, and which true body each found one covers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomocap.evaluation.result import Curve, Evaluation
from geomocap.evaluation.truth import Truth
from geomocap.files.frame_files import read_points
from geomocap.files.run import Run

CORE_WEIGHT = 0.8  # a surface point belongs to a body's core when the body's skin weight there is at least this much
NEAR_FRACTION = 0.05  # points farther from the true surface than this fraction of the height aren't judged


@dataclass(frozen=True)
class LabelledFrame:
    """Points of one frame with found and true bodies.

    Attributes
    ----------
    points : (N, 3) float, metres
    found : (N,) int
        -1 where unassigned.
    true : (N,) int
    near : (N,) bool
        Near enough to the true surface to be judged.
    core : (N,) bool or None
        In the core of a true body; None without skin weights.
    distance : (N,) float, metres
        From the true surface.
    """

    points: np.ndarray
    found: np.ndarray
    true: np.ndarray
    near: np.ndarray
    core: np.ndarray | None
    distance: np.ndarray


def labelled_frame(run: Run, truth: Truth, frame: int) -> LabelledFrame:
    """Read a frame's bodies, and find the true body at the closest surface point of each."""
    read = read_points(run.frame_file("bodies", frame))
    points, found = read.positions, read.body
    closest, face, corners, _ = truth.surface(frame).closest(points)
    distance = np.linalg.norm(closest - points, axis=1)
    near = distance < NEAR_FRACTION * truth.height
    weights = truth.body_weights
    if weights is None:
        true = truth.bodies.of_joint[truth.vertex_joint[truth.faces[face, 0]]]
        return LabelledFrame(points, found, true, near, None, distance)
    at_point = np.einsum("nk,nkb->nb", corners, weights[truth.faces[face]])
    core = near & (at_point.max(axis=1) >= CORE_WEIGHT)
    return LabelledFrame(points, found, at_point.argmax(axis=1), near, core, distance)


def judge_bodies(run: Run, truth: Truth, frames: Sequence[int]) -> tuple[Evaluation, np.ndarray | None]:
    """Compare a run's bodies with the true ones.

    Returns
    -------
    Evaluation
    votes : (true bodies, found bodies) int, or None if the run has no bodies
        Points near the surface with each pair of labels.
    """
    pairs: list[np.ndarray] = []
    index, core_index, core_fraction, judged = [], [], [], []
    for k in frames:
        if not run.frame_file("bodies", k).is_file():
            continue
        frame = labelled_frame(run, truth, k)
        if frame.core is not None:
            core_index.append(adjusted_rand_index(frame.found[frame.core], frame.true[frame.core]))
            core_fraction.append(frame.core.sum() / max(frame.near.sum(), 1))
        index.append(adjusted_rand_index(frame.found[frame.near], frame.true[frame.near]))
        ok = frame.near & (frame.found >= 0)
        pairs.append(np.stack([frame.true[ok], frame.found[ok]]))
        judged.append(k)
    if not judged:
        return Evaluation({}), None
    true, found = np.concatenate(pairs, axis=1)
    votes = np.zeros((len(truth.bodies), int(found.max(initial=0)) + 1), int)
    np.add.at(votes, (true, found), 1)
    figures = {
        "bodies.found": int((votes.sum(axis=0) > 0).sum()),
        "bodies.adjusted_rand_index": float(np.mean(index)),
        "bodies.adjusted_rand_index_worst_frame": float(np.min(index)),
    }
    at = np.array(judged)
    curves = [Curve("bodies: adjusted Rand index", "1", at, np.array(index))]
    if core_index:
        figures["bodies.core_adjusted_rand_index"] = float(np.mean(core_index))
        figures["bodies.core_fraction"] = float(np.mean(core_fraction))
        curves.append(Curve("bodies: adjusted Rand index of the cores", "1", at, np.array(core_index)))
    return Evaluation(figures, tuple(curves)), votes


def adjusted_rand_index(a: np.ndarray, b: np.ndarray) -> float:
    """Agreement of two labellings, (N,) each: 1 if they are the same but for names, about 0 if by chance; 0 of nothing.

    Hubert & Arabie (1985), Comparing partitions, equation 5.
    """
    if len(a) == 0:
        return 0.0
    _, a = np.unique(a, return_inverse=True)
    _, b = np.unique(b, return_inverse=True)
    table = np.zeros((a.max() + 1, b.max() + 1))
    if table.shape in ((1, 1), (len(a), len(a))):  # both all in one, or each for itself: the formula is 0 / 0
        return 1.0
    np.add.at(table, (a, b), 1)
    together, in_a, in_b = _pairs(table), _pairs(table.sum(axis=1)), _pairs(table.sum(axis=0))
    expected = in_a * in_b / (len(a) * (len(a) - 1) / 2)
    return float((together - expected) / max((in_a + in_b) / 2 - expected, 1e-12))


def _pairs(counts: np.ndarray) -> float:
    return float((counts * (counts - 1) / 2).sum())
