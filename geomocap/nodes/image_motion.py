"""Nodes followed in the images too: geometry says where a surface is, images how it moves within itself.

From the reference frame on, both ways, each frame's nodes answer to the frame's points, to their own stiffness and to
the images of earlier frames, in one system of equations. Earlier frames are several, near and far in time: near ones
look alike, far ones and the reference keep errors from adding up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.rotations import nearest_rotation
from geomocap.nodes.anchors import AnchorPoints, Anchors, find_homes
from geomocap.nodes.correspondences import Target, pull
from geomocap.nodes.deformation import BlockPattern, step
from geomocap.nodes.image_pull import HALF, LEAST_COSINE, FrameImages, window_pulls
from geomocap.nodes.node_graph import NodeGraph
from geomocap.nodes.surface_coverage import limbs_apart

EARLIER = (1, 4, 16)
"""Frames before the present one that its images are compared with, besides the reference frame."""
_SCALE = 0.6  # distance at which a point loses its weight, node spacings
_STEPS = (3, 3)  # on coarse and on fine images
_SPREAD = (3.0, 1.0)  # pixels between those of a window, on coarse and on fine images
_NORMAL = 1.4826  # standard deviation of a normal distribution, from its median distance
_DEPARTED = 3.0  # squared differences of so many times the median lose three quarters of their weight
_LEAST = 1e-6  # squared grey levels; images that are even differ by less
# Node spacings between two places of a node, of which one is wrong: limbs that were lost were off by three and more,
# and of less than one a fit takes care. No other value was tried.
_APART = 2.0
_TORN = 1e-3  # of its stiffness a torn edge keeps: a node that nothing else holds stays beside its neighbours
_CORRELATED = 0.3  # of the points' pull is counted: a hull's errors are alike over a piece of it

NodeState = tuple[np.ndarray, np.ndarray]
"""Places (N, 3) and rotations (N, 3, 3) of the nodes in a frame."""


@dataclass(frozen=True)
class _Earlier:
    """An earlier frame: its images, samples, their tangent axes, and how squarely cameras saw them."""

    images: FrameImages
    places: np.ndarray
    axes: np.ndarray
    cosine: np.ndarray


@dataclass(frozen=True)
class ImageMotion:
    """Follows a node graph through frames of points and images.

    Attributes
    ----------
    graph : NodeGraph
    pattern : BlockPattern
    point_spacing : float
        Distance of neighbouring points of a frame.
    stiffness : (E,) float
        Of each edge.
    give, strain_cost : float
        See `NodeTrackingSettings`.
    point_weight : float
        Pull along the surface relative to that across it.
    """

    graph: NodeGraph
    pattern: BlockPattern
    point_spacing: float
    stiffness: np.ndarray
    give: float
    strain_cost: float
    point_weight: float

    def follow(
        self,
        frames: list[Target],
        read: Callable[[int], FrameImages],
        geometric: list[NodeState],
        reference: int,
        way: int,
        known: Anchors,
    ) -> list[NodeState]:
        """Follow the graph from the reference frame on, forwards (way 1) or backwards (way −1).

        Each frame is tried from where the motion so far leads, from there moved as the geometry alone moves, and with
        limbs that the geometry has elsewhere put there; what explains points and images better is kept. A limb that is
        elsewhere then than its motion led to had been lost, and is followed back into the frames before.

        Parameters
        ----------
        frames : list of Target
        read : callable
            `read(frame)`; frames are asked for in their order, once each.
        geometric : list of NodeState
            All frames, followed in the geometry alone.
        reference, way : int
        known : Anchors
            Nodes near them don't slide.

        Returns
        -------
        list of NodeState
            The reference's first.
        """
        g = self.graph
        states: list[NodeState] = [(g.nodes, np.tile(np.eye(3), (len(g.nodes), 1, 1)))]
        seen = [self._seen(read(reference), states[0])]
        first = seen[0]
        homes = find_homes(g, *states[0], known, reference)

        def marks_of(frame: int) -> AnchorPoints:
            return AnchorPoints.of(g, homes, known, frame)

        for t in range(reference + way, len(frames) if way > 0 else -1, way):
            images = read(t)
            earlier = _compared_with(seen, first)
            starts = [_carried(geometric[t - way], geometric[t], states[-1], g.spacing)]
            if len(states) > 1:
                starts.insert(0, _continued(states[-2], states[-1]))
            elsewhere = self._apart(starts[0], geometric[t])
            if elsewhere.any():
                starts.append(_with_limbs(starts[0], geometric[t], elsewhere))
            marks = marks_of(t)
            starts = [marks.move(g, *start, self.give, self._scale()) for start in starts]
            found = [self._fit(frames[t], images, earlier, marks, start, 0) for start in starts]
            best = found[self._better(frames[t], found)][0]
            states.append(self._fit(frames[t], images, earlier, marks, best, 1)[0])
            new = np.isnan(homes[:, 0])
            homes[new] = find_homes(g, *states[-1], known, t)[new]
            if self._apart(states[-1], starts[0]).any():
                self._follow_back(frames[reference::way], lambda k: marks_of(reference + way * k), states, seen, first)
            seen = [*seen[-max(EARLIER) + 1 :], self._seen(images, states[-1])]
        return states

    def _follow_back(
        self,
        frames: list[Target],
        marks: Callable[[int], AnchorPoints],
        states: list[NodeState],
        seen: list[_Earlier],
        first: _Earlier,
    ) -> None:
        """Put limbs that the last state has found again right in the states before it, in place, while that is better.

        Parameters
        ----------
        frames, marks
            Of each state.
        states : list of NodeState
        seen : list of _Earlier
            Of the states before the last one, as many as are known.
        first : _Earlier
            Of the reference frame.
        """
        for back in range(1, min(len(seen), len(states) - 1)):
            k = len(states) - 1 - back
            images, earlier = seen[-back].images, _compared_with(seen[:-back], first)
            after = states[k + 1] if back < 2 else _continued(states[k + 2], states[k + 1])
            start = _with_limbs(states[k], after, self._apart(states[k], states[k + 1]))
            levels = ((states[k], (1,)), (start, (0, 1)))
            found = []
            for state, of in levels:
                for level in of:
                    state, errors = self._fit(frames[k], images, earlier, marks(k), state, level)
                found.append((state, errors))
            if self._better(frames[k], found) == 0:
                return
            changed = self._apart(states[k], found[1][0])
            states[k], seen[-back] = found[1][0], self._seen(images, found[1][0])
            if not changed.any():
                return

    def _apart(self, one: NodeState, other: NodeState) -> np.ndarray:
        """Nodes that are clearly elsewhere in two states, (N,) bool; none if they are fewer than the smallest limb."""
        return limbs_apart(one[0], other[0], _APART * self.graph.spacing)

    def _better(self, frame: Target, found: list[tuple[NodeState, np.ndarray]]) -> int:
        """Return which state leaves least of the points and of the images unexplained and is strained least.

        Images are compared where both states have them.
        """
        frame = replace(frame)  # what is kept with it goes with it
        both = np.logical_and.reduce([np.isfinite(e) for _, e in found])
        usual = max(float(np.median([e[both] for _, e in found])), _LEAST) if both.any() else 1.0
        costs = []
        for (x, R), errors in found:
            y, normals = self.graph.deform(x, R)
            c = self._scale()
            points = pull(frame, y, normals, self.graph.features, c, 0.0, 0.0)
            strain = float(np.minimum((self.graph.strain(x, R) / self.give) ** 2, 1.0).mean())
            unlike = float((errors[both] / (errors[both] + usual)).mean()) if both.any() else 0.0
            costs.append(points.energy + self.strain_cost * strain + unlike)
        return int(np.argmin(costs))

    def _scale(self) -> float:
        return max(_SCALE * self.graph.spacing, 1.5 * self.point_spacing)

    def _seen(self, images: FrameImages, state: NodeState) -> _Earlier:
        y, normals = self.graph.deform(*state)
        return _Earlier(images, y, self._axes(state[1]), images.look(y, normals)[0])

    def _axes(self, R: np.ndarray) -> np.ndarray:
        """Two axes of the tangent plane of each sample, turned as its nodes are: (S, 2, 3)."""
        g = self.graph
        turn = (g.weights[..., None, None] * R[g.binding]).sum(axis=1)
        return np.ascontiguousarray(np.einsum("sij,skj->ski", turn, self._axes_at_rest))

    @cached_property
    def _axes_at_rest(self) -> np.ndarray:
        """Two axes of the tangent plane of each sample in the reference frame, (S, 2, 3)."""
        n = self.graph.normals
        other = np.where(np.abs(n[:, :1]) < 0.7, np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]))
        first = np.cross(n, other)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(n, first)], axis=1)

    def _fit(
        self,
        frame: Target,
        images: FrameImages,
        earlier: list[_Earlier],
        marks: AnchorPoints,
        start: NodeState,
        level: int,
    ) -> tuple[NodeState, np.ndarray]:
        """Fit on images of a level; the state, and the mean squared difference of each window, NaN where not seen."""
        x, R = start
        g, c = self.graph, self._scale()
        frame = replace(frame, points=frame.points.turned_like(*g.deform(x, R), 0.5 * g.spacing))
        fraction = len(g.samples) / len(g.nodes) / 4
        errors = np.zeros((0,))
        for _ in range(_STEPS[level]):
            y, normals = g.deform(x, R)
            found = pull(frame, y, normals, g.features, c, self.point_weight, 0.0)
            A, b = _CORRELATED * found.A, _CORRELATED * found.b
            noise = max(_NORMAL * float(np.median(np.abs(found.across))), 0.3 * self.point_spacing)
            errors = self._add_images(A, b, noise, images, earlier, y, normals, self._axes(R), level)
            marks.add_to(A, b, g, x, R, noise**2, c)
            soft = np.maximum(1 / (1 + (g.strain(x, R) / self.give) ** 2) ** 2, _TORN)
            x, R = step(g, self.pattern, x, R, self.stiffness * fraction * soft, A, b, 60)
        return (x, R), errors

    def _add_images(
        self,
        A: np.ndarray,
        b: np.ndarray,
        noise: float,
        images: FrameImages,
        earlier: list[_Earlier],
        y: np.ndarray,
        normals: np.ndarray,
        axes: np.ndarray,
        level: int,
    ) -> np.ndarray:
        """Add what images pull to A (S, 3, 3) and b (S, 3), in place; the windows' mean squared differences (E, S, C).

        Points pull with weight 1 at their standard deviation `noise`; images' weights are put into that unit. Pixels
        that the windows of several samples hold count once.
        """
        S, C = len(y), len(images.projections)
        cosine, pixel = images.look(y, normals)
        spread = _SPREAD[level] * pixel
        own = 0.9 * self.graph.spacing**2 * len(self.graph.nodes) / S
        once = np.minimum(own / ((2 * HALF + 1) * spread) ** 2 * np.maximum(cosine, LEAST_COSINE), 1.0)
        # always as many earlier frames, so that the kernel is one: the last is repeated, and not looked at
        count = len(earlier)
        padded = earlier + [earlier[-1]] * (len(EARLIER) + 1 - count)
        seen = np.stack([(cosine > 0) & (then.cosine > 0) & (k < count) for k, then in enumerate(padded)])
        more, pulled = np.zeros((len(padded), S, C, 3, 3)), np.zeros((len(padded), S, C, 3))
        total, pixels = np.zeros((len(padded), S, C)), np.zeros((len(padded), S, C), np.int64)
        window_pulls(
            images.levels[level],
            images.projections,
            images.masks,
            tuple(then.images.levels[level] for then in padded),
            tuple(then.images.projections for then in padded),
            tuple(then.images.masks for then in padded),
            y,
            axes,
            np.stack([then.places for then in padded]),
            np.stack([then.axes for then in padded]),
            spread,
            seen,
            HALF,
            more,
            pulled,
            total,
            pixels,
        )
        errors = np.full((count, S, C), np.nan)
        for k in range(count):
            known = pixels[k] > 0
            if not known.any():
                continue
            mean = total[k] / np.maximum(pixels[k], 1)
            usual = max(float(np.median(mean[known])), _LEAST)
            weight = np.where(known, once / (1 + mean / (_DEPARTED * usual)) ** 2, 0.0) * noise**2 / usual
            A += (weight[:, None] @ more[k].reshape(S, C, 9)).reshape(S, 3, 3)
            b += (weight[:, None] @ pulled[k])[:, 0]
            errors[k][known] = mean[known]
        return errors


def _continued(before: NodeState, last: NodeState) -> NodeState:
    """Go on with the motion of the last frame."""
    (x0, R0), (x, R) = before, last
    return 2 * x - x0, R @ R0.transpose(0, 2, 1) @ R


def _compared_with(seen: list[_Earlier], first: _Earlier) -> list[_Earlier]:
    """Those of the frames before that images are compared with, and the reference frame."""
    earlier = [seen[-k] for k in EARLIER if k <= len(seen)]
    return earlier if any(one is first for one in earlier) else [*earlier, first]


def _with_limbs(state: NodeState, other: NodeState, nodes: np.ndarray) -> NodeState:
    """A state with some nodes, (N,) bool, as another has them."""
    return np.where(nodes[:, None], other[0], state[0]), np.where(nodes[:, None, None], other[1], state[1])


def _carried(before: NodeState, after: NodeState, state: NodeState, spacing: float) -> NodeState:
    """Move a state as the nodes of another solution that are near it move between two frames."""
    x, R = state
    distance, near = cKDTree(before[0]).query(x, 4)
    weight = np.exp(-0.5 * (distance / spacing) ** 2) + 1e-9
    weight /= weight.sum(axis=1, keepdims=True)
    turn = after[1] @ before[1].transpose(0, 2, 1)
    moved = after[0][near] + np.einsum("nkij,nkj->nki", turn[near], x[:, None] - before[0][near])
    blend = (weight[..., None, None] * turn[near]).sum(axis=1)
    return (weight[..., None] * moved).sum(axis=1), nearest_rotation(blend) @ R
