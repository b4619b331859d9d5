"""Tracked surface points against the points of the true surface that they began on."""

from __future__ import annotations

import numpy as np

from geomocap.evaluation.result import Curve, Evaluation
from geomocap.evaluation.truth import Truth

FAR_MM = 20.0


def judge_tracks(positions: np.ndarray, truth: Truth) -> Evaluation:
    """Measure how far tracks drift from the surface points that they began on.

    Parameters
    ----------
    positions : (N, T, 3) float
        NaN where not tracked, metres.
    truth : Truth
    """
    positions = positions.astype(float)
    T = min(positions.shape[1], truth.n_frames)
    tracked = np.isfinite(positions[:, :T, 0])
    first = tracked.argmax(axis=1)
    drifts: list[np.ndarray] = []
    by_frame: list[list[np.ndarray]] = [[] for _ in range(T)]
    for k in range(T):
        ids = np.flatnonzero(tracked.any(axis=1) & (first == k))
        if not len(ids):
            continue
        _, face, corners, _ = truth.surface(k).closest(positions[ids, k])
        anchor = np.einsum("nk,tnkc->tnc", corners, truth.vertices[:, truth.faces[face]])
        start = positions[ids, k] - anchor[k]
        drift = np.linalg.norm(positions[ids, :T].transpose(1, 0, 2) - anchor[:T] - start, axis=-1) * 1000
        later = tracked[ids].T
        drifts.append(drift[k + 1 :][later[k + 1 :]])
        for t in range(k + 1, T):
            by_frame[t].append(drift[t][later[t]])
    drift = np.concatenate(drifts) if drifts else np.array([np.nan])
    figures = {
        "tracks.count": int(tracked.any(axis=1).sum()),
        "tracks.mean_length_frames": float(tracked.sum(axis=1).mean()),
        "tracks.drift_median": np.median(drift),
        "tracks.drift_p95": np.percentile(drift, 95),
        "tracks.fraction_drifting_over_20mm": float(np.mean(drift > FAR_MM)),
    }
    frames = [t for t in range(T) if by_frame[t] and len(np.concatenate(by_frame[t]))]
    medians = np.array([np.median(np.concatenate(by_frame[t])) for t in frames])
    return Evaluation(figures, (Curve("tracks: median drift since their beginning", "mm", np.array(frames), medians),))
