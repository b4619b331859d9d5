"""Found joints, connections and body rotations against the true ones."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from geomocap.evaluation.result import Curve, Evaluation, Match
from geomocap.evaluation.truth import Truth
from geomocap.model.rotations import relative_turns, turn_angles
from geomocap.model.skeleton import Skeleton

FOUND_WITHIN, WELL_WITHIN, CAP = 0.10, 0.05, 0.15  # fractions of the height
LOST = 10.0  # heights: what a joint without a position counts as


def judge_skeleton(skeleton: Skeleton, truth: Truth, votes: np.ndarray | None) -> Evaluation:
    """Compare a run's skeleton with the true one.

    Joints are matched one to one by their mean distance over time. A true joint counts as found when its partner's mean
    distance is under a tenth of the height. A skeleton without joints has a recall of 0, and no precision.

    Parameters
    ----------
    skeleton : Skeleton
    truth : Truth
    votes : (true bodies, found bodies) int, optional
        From `judge_bodies`; without it connections and rotations aren't judged.
    """
    positions = skeleton.joint_positions
    T = min(len(positions), truth.n_frames)
    active = truth.bodies.jointed
    if T == 0 or len(active) == 0:
        return Evaluation({})
    positions, h = positions[:T], truth.height
    true = truth.joint_positions[:T, truth.bodies.root[active]]
    distance = np.linalg.norm(positions[:, :, None] - true[:, None], axis=-1)
    distance = np.nan_to_num(distance, nan=LOST * h)
    mean = distance.mean(axis=0)
    row, column = linear_sum_assignment(np.minimum(mean, CAP * h))
    good = mean[row, column] < FOUND_WITHIN * h
    error = mean[row, column][good]
    figures: dict[str, float] = {
        "joints.found": positions.shape[1],
        "joints.true": len(active),
        "joints.recall_at_10%h": float(good.sum() / len(active)),
        "joints.recall_at_5%h": float((error < WELL_WITHIN * h).sum() / len(active)),
    }
    if positions.shape[1]:
        figures["joints.precision_at_10%h"] = float(good.sum() / positions.shape[1])
    curves: list[Curve] = []
    matches: list[Match] = []
    pairs = list(zip(row[good].tolist(), column[good].tolist(), strict=True))
    if pairs:
        each = np.stack([distance[:, i, j] for i, j in pairs])
        jitter = [_jitter(positions[:, i] - true[:, j]) for i, j in pairs]
        figures["joints.mean_error"] = error.mean() * 1000
        figures["joints.mean_error_%h"] = error.mean() / h * 100
        figures["joints.p95_error"] = np.percentile(each, 95) * 1000
        figures["joints.jitter_second_difference"] = float(np.mean(jitter)) * 1000
        curves.append(Curve("joints: mean distance from the true ones", "mm", np.arange(T), each.mean(axis=0) * 1000))
        for (i, j), d in zip(pairs, each, strict=True):
            name = str(truth.joint_names[truth.bodies.root[active[j]]])
            seen = int(np.isfinite(positions[:, i, 0]).sum())
            found = str(skeleton.joint_names[i])
            matches.append(Match(found, name, d.mean() * 1000, np.percentile(d, 95) * 1000, seen))
            curves.append(Curve(f"joint {name}: distance of {found}", "mm", np.arange(T), d * 1000))
    if votes is not None:
        figures |= _judge_edges(skeleton.joint_bodies, truth, votes)
        turned = _judge_rotations(skeleton.body_rotations[:T], truth, votes)
        figures |= turned.figures
        curves += turned.curves
    return Evaluation(figures, tuple(curves), tuple(matches))


def _jitter(difference: np.ndarray) -> float:
    """Mean length of the second difference over time of (T, 3)."""
    if len(difference) <= 2:
        return 0.0
    return float(np.linalg.norm(np.diff(difference, n=2, axis=0), axis=1).mean())


def _judge_edges(joint_bodies: np.ndarray, truth: Truth, votes: np.ndarray) -> dict[str, float]:
    """Which true connections were found; a found body stands for the true one that most of its points lie on."""
    to_true = np.zeros(max(votes.shape[1], int(joint_bodies.max(initial=0)) + 1), int)
    to_true[: votes.shape[1]] = votes.argmax(axis=0)
    true = {_edge(b, int(truth.bodies.parent[b])) for b in truth.bodies.jointed.tolist()}
    found = {_edge(int(to_true[a]), int(to_true[b])) for a, b in joint_bodies}
    wrong = [e for e in found if e not in true and e[0] != e[1]]
    return {
        "skeleton.true_edges_found": float(len(true & found) / len(true)),
        "skeleton.false_edges": len(wrong),
    }


def _edge(a: int, b: int) -> tuple[int, int]:
    return (min(a, b), max(a, b))


def _judge_rotations(rotations: np.ndarray, truth: Truth, votes: np.ndarray) -> Evaluation:
    """Turns since the first frame about world axes, of each true body against the found body that covers it best."""
    T = len(rotations)
    errors, curves = [], []
    for b in truth.bodies.jointed.tolist():
        k = int(votes[b].argmax())
        if votes[b, k] == 0 or k >= rotations.shape[1]:
            continue
        root = int(truth.bodies.root[b])
        true = _since_first(truth.joint_rotations[:T, root])
        error = np.rad2deg(turn_angles(relative_turns(true, _since_first(rotations[:, k]))))
        errors.append(error.mean())
        curves.append(Curve(f"body {truth.joint_names[root]}: rotation error", "°", np.arange(T), error))
    if not errors:
        return Evaluation({})
    mean = np.mean([c.values for c in curves], axis=0)
    curves.insert(0, Curve("bodies: mean rotation error", "°", np.arange(T), mean))
    return Evaluation({"motion.body_rotation_error_deg": float(np.mean(errors))}, tuple(curves))


def _since_first(rotations: np.ndarray) -> np.ndarray:
    return np.einsum("tij,kj->tik", rotations, rotations[0])
