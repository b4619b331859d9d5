"""Which bodies are connected: the spanning tree of the cheapest joints, and its root."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree

from geomocap.model.hierarchy import Hierarchy
from geomocap.skeleton.borders import Border
from geomocap.skeleton.common_points import CommonPoint


@dataclass(frozen=True)
class Connection:
    """Two bodies that may be connected, and what it costs.

    Attributes
    ----------
    bodies : tuple of two int
    joint : CommonPoint
    border : Border
        Where they touch.
    cost : float, metres
    """

    bodies: tuple[int, int]
    joint: CommonPoint
    border: Border
    cost: float


def connection_cost(
    miss: float, from_interface: float, gap: float, contact: float, weights: tuple[float, float, float]
) -> float:
    """Cost of a joint, metres: what it misses, plus distances that a joint should not have.

    Parameters
    ----------
    miss : float, metres
        How far the two bodies carry the joint apart.
    from_interface : float, metres
        Distance of the joint from where the bodies touch.
    gap : float, metres
        Distance of the bodies.
    contact : float
        Length of the border between them as a fraction of what the smaller of the two has in all, 0 to 1.
    weights : three floats
        Of distance from the interface and gap (no unit), and of missing contact (metres).
    """
    return miss + weights[0] * from_interface + weights[1] * gap + weights[2] * (1.0 - contact)


def connect_by_cost(
    connections: list[Connection], bodies: int, sizes: np.ndarray
) -> tuple[Hierarchy, list[Connection]]:
    """Spanning tree of least cost, hung up at a large body in the middle.

    The root is the body that minimises the mean number of joints to all surface, less a bonus for its own size: the
    trunk, to which many limbs are connected and which is large.

    Parameters
    ----------
    connections : list of Connection
        All pairs of bodies must be connected through them.
    bodies : int
    sizes : (B,) float
        Fraction of the samples.

    Returns
    -------
    Hierarchy
    list of Connection
        Of the joints, in the hierarchy's order.
    """
    by_pair = {tuple(sorted(c.bodies)): c for c in connections}
    rows = [pair[0] for pair in by_pair]
    columns = [pair[1] for pair in by_pair]
    costs = [max(c.cost, 1e-9) for c in by_pair.values()]
    tree = minimum_spanning_tree(csr_matrix((costs, (rows, columns)), shape=(bodies, bodies)))
    hops = dijkstra((tree > 0).astype(float), directed=False, unweighted=True)
    root = int(np.argmin(hops @ sizes + hops.mean(axis=1) - 2.0 * sizes))
    linked = (tree + tree.T).tocsr()
    order, waiting, placed = [], [root], {root}
    while waiting:
        parent = waiting.pop(0)
        for child in sorted(linked.indices[linked.indptr[parent] : linked.indptr[parent + 1]].tolist()):
            if child not in placed:
                placed.add(child)
                waiting.append(child)
                order.append((parent, child))
    chosen = [by_pair[min(p, c), max(p, c)] for p, c in order]
    return Hierarchy(root, np.array(order, np.int32).reshape(-1, 2)), chosen
