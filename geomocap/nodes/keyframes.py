"""The frame to begin with: the one whose surface is stretched out most, so that least of it touches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from geomocap.nodes.node_graph import largest_parts


def openness(graph: csr_matrix, landmarks: int = 24) -> float:
    """Mean distance along the surface between far points and all points, metres.

    Limbs that touch open short cuts, and limbs that have grown together lose surface: both make it smaller.
    """
    kept = largest_parts(graph, 0.02)
    graph = graph[kept][:, kept]
    distance = np.full(graph.shape[0], np.inf)
    chosen = 0
    total = 0.0
    for k in range(landmarks + 1):
        reached = dijkstra(graph, directed=False, indices=chosen)
        finite = np.isfinite(reached)
        if k:  # the first one only finds an end to begin with
            total += float(reached[finite].mean())
            distance = np.minimum(distance, reached)
        else:
            distance = -reached
            distance[~finite] = -np.inf
            chosen = int(distance.argmin()) if finite.all() else int(np.where(finite, reached, -1).argmax())
            distance = np.full(graph.shape[0], np.inf)
            continue
        chosen = int(distance.argmax())
    return total / landmarks


def most_open(values: Sequence[float], frames: Sequence[int], n_frames: int) -> int:
    """The frame with the greatest openness among its neighbours in time.

    Near equals are chosen by how near they are to the middle of the sequence, from which no frame is far.

    Parameters
    ----------
    values : sequence of float
        Openness of each candidate, metres.
    frames : sequence of int
        Candidates.
    n_frames : int
        Length of the sequence.
    """
    value = np.asarray(values, float)
    ends = np.concatenate([value[:1], value, value[-1:]])
    smooth = (ends[:-2] + 2 * value + ends[2:]) / 4
    away = np.abs(np.asarray(frames) - (n_frames - 1) / 2) / n_frames
    return int(frames[int(np.argmax(smooth * (1 - 0.1 * away)))])
