"""The coarse motion of a surface: which limb went where, decided among several starts for each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.nodes.anchors import AnchorPoints, Anchors, find_homes
from geomocap.nodes.correspondences import Pull, Target, pull
from geomocap.nodes.deformation import BlockPattern, block_pattern, step
from geomocap.nodes.extremities import match_ends
from geomocap.nodes.node_graph import NodeGraph
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.surface_coverage import limbs_apart
from geomocap.scheduling import map_here

# Distance at which correspondences lose their weight (node spacings) and stiffness, step by step.
_SETTLE = ((0.8, 2.0), (0.8, 1.0), (0.8, 1.0), (0.6, 1.0), (0.6, 1.0), (0.6, 1.0), (0.4, 1.0), (0.4, 1.0), (0.3, 1.0))
NEAR = ((0.8, 8.0), (0.8, 4.0), *_SETTLE)
FAR = ((2.0, 8.0), (1.5, 8.0), (1.2, 4.0), *_SETTLE)
# Node spacings from halfway between the neighbours in time, where a limb is that jumps by one spacing. Legs of a
# galloping stag that were lost jumped by two and more. No other value was tried.
_AWAY = 0.5
_BAD = 1.3  # cost from which a frame is tried again, relative to the median


@dataclass(frozen=True)
class State:
    """Nodes in one frame.

    Attributes
    ----------
    x : (N, 3) float, metres, world
    R : (N, 3, 3) float
        Rotation since the reference frame.
    cost : float
        Fraction of the surface that is not explained, and its strain.
    """

    x: np.ndarray
    R: np.ndarray
    cost: float = 0.0


@dataclass(frozen=True)
class CoarseTarget:
    """A frame's points, thinned, the ends of its limbs (E, 3), metres, and what is known of single points of it."""

    target: Target
    ends: np.ndarray
    marks: AnchorPoints | None = None


@dataclass(frozen=True)
class CoarseModel:
    """The coarse graph of the reference surface.

    Attributes
    ----------
    graph : NodeGraph
    pattern : BlockPattern
    ends : (E,) int
        Samples at the ends of limbs.
    tips : tuple of (n,) int
        Samples that belong to each end.
    point_spacing : float
        Distance of neighbouring points of a frame, metres.
    edge_weights : (E,) float
        1, or 0 for edges that are false contacts.
    """

    graph: NodeGraph
    pattern: BlockPattern
    ends: np.ndarray
    tips: tuple[np.ndarray, ...]
    point_spacing: float
    edge_weights: np.ndarray
    settings: NodeTrackingSettings

    @classmethod
    def of(
        cls, graph: NodeGraph, ends: np.ndarray, point_spacing: float, settings: NodeTrackingSettings
    ) -> CoarseModel:
        """Make the model from a graph and the positions of its limbs' ends (E, 3) in the reference frame."""
        tree = cKDTree(graph.samples)
        at = tree.query(ends)[1] if len(ends) else np.zeros(0, int)
        tips = tuple(np.array(t, int) for t in tree.query_ball_point(graph.samples[at], 0.7 * graph.spacing))
        return cls(graph, block_pattern(graph), at, tips, point_spacing, np.ones(len(graph.edges)), settings)

    def start(self) -> State:
        """Return the reference frame's state."""
        return State(self.graph.nodes, np.tile(np.eye(3), (len(self.graph.nodes), 1, 1)))

    def next_state(self, frame: CoarseTarget, last: State, before: State | None) -> State:
        """Find the nodes in the next frame: from where they are expected and from where they were, near and far."""
        starts = [last] if before is None else [self.expected(last, before), last]
        unsided, frame = frame, self.sided(frame, starts[0])
        tries = [(start, *how) for start in starts for how in ((NEAR, False), (FAR, True))]
        found = map_here(lambda this: self.fit(frame, *this), tries)
        best = min(found, key=lambda s: self.cost(s, starts[0]))
        turned = self.sided(unsided, best)
        if np.array_equal(turned.target.points.normals, frame.target.points.normals):
            return best
        return min(best, self.fit(turned, best, NEAR, False), key=lambda s: s.cost)

    def sided(self, frame: CoarseTarget, state: State) -> CoarseTarget:
        """Turn the frame's normals to the side that the surface has in a state."""
        points = frame.target.points.turned_like(*self.graph.deform(state.x, state.R), 0.5 * self.graph.spacing)
        return replace(frame, target=replace(frame.target, points=points))

    def marked(self, target: CoarseTarget, homes: np.ndarray, anchors: Anchors, frame: int) -> CoarseTarget:
        """Add to a frame what is known of points with homes (P, 3), NaN where not known."""
        return replace(target, marks=AnchorPoints.of(self.graph, homes, anchors, frame)) if len(homes) else target

    def cost(self, state: State, expected: State) -> float:
        """Cost of a state, and of being elsewhere than expected: limbs that seem to have changed places have not."""
        away = np.linalg.norm(state.x - expected.x, axis=1) / (2 * self.graph.spacing)
        return state.cost + self.settings.inertia_cost * float((np.minimum(away, 1.0) ** 2).mean())

    def between(self, last: State, following: State) -> State:
        """Halfway between two states, made as rigid as can be."""
        half = Rotation.from_matrix(following.R @ last.R.transpose(0, 2, 1)).as_rotvec() / 2
        return self._relaxed((last.x + following.x) / 2, Rotation.from_rotvec(half).as_matrix() @ last.R)

    def expected(self, last: State, before: State) -> State:
        """Go on with the motion of the last frame, made as rigid as can be."""
        m = self.settings.momentum
        turn = Rotation.from_matrix(last.R @ before.R.transpose(0, 2, 1)).as_rotvec()
        return self._relaxed(last.x + m * (last.x - before.x), Rotation.from_rotvec(m * turn).as_matrix() @ last.R)

    def _relaxed(self, x: np.ndarray, R: np.ndarray) -> State:
        hold = np.tile(0.05 * np.eye(3), (len(self.graph.samples), 1, 1))
        y = self.graph.deform(x, R)[0]
        for _ in range(2):
            now = self.graph.deform(x, R)[0]
            x, R = self._step(x, R, hold, 0.05 * (now - y), 1.0)
        return State(x, R)

    def fit(self, frame: CoarseTarget, start: State, schedule: tuple[tuple[float, float], ...], by_ends: bool) -> State:
        """Fit the graph to a frame.

        Parameters
        ----------
        schedule : tuple of (scale, stiffness)
            Scale in node spacings.
        by_ends : bool
            Whether limbs' ends are matched and pulled first.
        """
        x, R = start.x, start.R
        if by_ends:
            x, R = self._pull_ends(frame, x, R)
        g, s = self.graph, self.settings
        for scale, stiffness in schedule:
            c = max(scale * g.spacing, 2 * self.point_spacing)
            found = self._pull(frame.target, x, R, c)
            if frame.marks is not None:
                frame.marks.add_to(found.A, found.b, g, x, R, s.anchor_weight, c)
            x, R = self._step(x, R, found.A, found.b, stiffness)
        found = self._pull(frame.target, x, R, max(0.3 * g.spacing, 2 * self.point_spacing))
        strain = np.minimum(g.strain(x, R) / s.give, 1.0) ** 2
        return State(x, R, found.energy + s.strain_cost * float(strain.mean()))

    def _pull_ends(self, frame: CoarseTarget, x: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y = self.graph.deform(x, R)[0]
        diagonal = float(np.linalg.norm(np.ptp(self.graph.nodes, axis=0)))
        own, seen = match_ends(y[self.ends], frame.ends, self.settings.end_reach * diagonal)
        goal, weight = y.copy(), np.zeros(len(y))
        for i, j in zip(own, seen, strict=True):
            goal[self.tips[i]] += frame.ends[j] - y[self.ends[i]]
            weight[self.tips[i]] = 1.0
        A = weight[:, None, None] * np.eye(3)
        for _ in range(4):
            now = self.graph.deform(x, R)[0]
            x, R = self._step(x, R, A, weight[:, None] * (now - goal), 1.0)
        return x, R

    def _pull(self, target: Target, x: np.ndarray, R: np.ndarray, scale: float) -> Pull:
        y, normals = self.graph.deform(x, R)
        s = self.settings
        return pull(target, y, normals, self.graph.features, scale, s.point_weight, s.feature_weight)

    def _step(
        self, x: np.ndarray, R: np.ndarray, A: np.ndarray, b: np.ndarray, stiffness: float
    ) -> tuple[np.ndarray, np.ndarray]:
        g = self.graph
        soft = 1 / (1 + (g.strain(x, R) / (2 * self.settings.give)) ** 2) ** 2
        fraction = len(g.samples) / len(g.nodes) / 4
        weights = stiffness * self.settings.stiffness * fraction * soft * self.edge_weights
        return step(g, self.pattern, x, R, weights, A, b, 60)


def follow(
    model: CoarseModel, frames: list[CoarseTarget], reference: int, way: int, anchors: Anchors | None = None
) -> tuple[list[State], np.ndarray]:
    """Follow the surface from the reference frame on, forwards (way 1) or backwards (way −1).

    Parameters
    ----------
    model : CoarseModel
    frames : list of CoarseTarget
    reference, way : int
    anchors : Anchors, optional
        Trajectories. Each one holds the surface from the frame on in which it is first met.

    Returns
    -------
    states : list of State
        The reference's first.
    homes : (P, 3) float, metres
        Where the anchors are in the reference frame; NaN: never met.
    """
    states = [model.start()]
    anchors = anchors or Anchors.none(len(frames))
    homes = find_homes(model.graph, states[0].x, states[0].R, anchors, reference)
    end = len(frames) if way > 0 else -1
    for k in range(reference + way, end, way):
        frame = model.marked(frames[k], homes, anchors, k)
        states.append(model.next_state(frame, states[-1], states[-2] if len(states) > 1 else None))
        new = np.isnan(homes[:, 0])
        homes[new] = find_homes(model.graph, states[-1].x, states[-1].R, anchors, k)[new]
    return states, homes


def mend(
    model: CoarseModel,
    frames: list[CoarseTarget],
    states: list[State],
    reference: int,
    ways: Sequence[int] = (-1, 1),
) -> list[State]:
    """Try frames that don't fit between their neighbours in time again, starting between and from the neighbours.

    They fit badly, or a limb is far from where it would be halfway between its neighbours. A limb that was lost or
    taken for another where it moved fast is found again from the other side: a limb in the wrong place costs little of
    the whole, but sooner or later it jumps, and from there on each frame is tried from the one after it. So it is gone
    through the frames forwards (way 1) and backwards (way −1), one after the other.
    """
    states = list(states)
    T = len(states)
    if T < 3:
        return states
    fits = [_Fits(model) for _ in states]
    for way in ways:
        between = [model.between(states[t - 1], states[t + 1]) for t in range(1, T - 1)]
        usual = float(np.median([model.cost(s, b) for s, b in zip(states[1:-1], between, strict=True)]))
        for t in range(1, T - 1) if way > 0 else range(T - 2, 0, -1):
            middle = model.between(states[t - 1], states[t + 1])
            jumps = limbs_apart(states[t].x, middle.x, _AWAY * model.graph.spacing).any()
            if t == reference or (model.cost(states[t], middle) < _BAD * usual and not jumps):
                continue
            tried = fits[t].of(model.sided(frames[t], middle), (middle, states[t + 1], states[t - 1]))
            states[t] = min([states[t], *tried], key=lambda s: model.cost(s, middle))
    return states


class _Fits:
    """Fits to one frame, each of which is made once."""

    def __init__(self, model: CoarseModel):
        self.model = model
        self.normals = np.zeros(0)
        self.made: list[tuple[State, State]] = []

    def of(self, frame: CoarseTarget, starts: Sequence[State]) -> list[State]:
        """Fit the frame, with its normals turned in some way, from each of some states."""
        if not np.array_equal(self.normals, frame.target.points.normals):
            self.normals, self.made = frame.target.points.normals, []
        new = [start for start in starts if self._known(start) is None]
        found = map_here(lambda start: self.model.fit(frame, start, NEAR, False), new)
        self.made += zip(new, found, strict=True)
        return [fit for start in starts if (fit := self._known(start)) is not None]

    def _known(self, start: State) -> State | None:
        for begun, fit in self.made:
            if np.array_equal(begun.x, start.x) and np.array_equal(begun.R, start.R):
                return fit
        return None
