"""How firmly the edges of a node graph hold, learned from a motion that all of them were asked to hold alike.

Within a bone an edge hardly strains in any frame, at a joint in most. In a deformation that is as rigid as possible an
edge's weight is the inverse variance of its strain, so that is what the strains of a first motion are put into.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomocap.nodes.image_motion import NodeState
from geomocap.nodes.node_graph import NodeGraph

_LEAST_STRAIN = 1e-4  # fraction of an edge's length
# Bounds of an edge's weight, relative to the usual one. Means over bones of the nodes' distance, 100 mm at most, from
# where their own bone has them, with all edges alike → with these bounds: galloping stag 17.6 → 16.5 mm, walking horse
# 12.2 → 10.9, bird 17.1 → 15.8, walking dwarf 47.4 → 47.7. Three times the weights: 19.1, 11.4, 13.8, 46.3; all edges
# three times as firm: 20.5, 12.8, 14.7, 46.5.
_BOUNDS = (0.3, 10.0)


def learned_stiffness(graph: NodeGraph, states: Sequence[NodeState]) -> np.ndarray:
    """Weights of the edges relative to the usual one, (E,): 1 where they strain as most do, more where less.

    The strain of an edge is its median over the frames, averaged over the edges around it.

    Parameters
    ----------
    graph : NodeGraph
    states : sequence of NodeState
        The nodes in each frame, in a motion with all edges alike.
    """
    strain = np.median([graph.strain(x, R) for x, R in states], axis=0)
    i, j = graph.edges.T
    around = graph.mean_of_edges(strain)
    usual = np.sqrt(around[i] * around[j]) + _LEAST_STRAIN
    middle = np.exp(np.log(usual).mean())
    return np.asarray(np.clip((middle / usual) ** 2, *_BOUNDS))
