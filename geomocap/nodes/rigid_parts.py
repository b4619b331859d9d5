"""A surface followed as rigid parts: its nodes grouped by their motion, and the parts registered to all frames.

Deformed as a skin, a hard part is held by a few points near each of its nodes; moved as one, by all of its shape, which
is what keeps it from sliding. Labels and motions are found in turns, as in articulated iterative closest points: S.
Pellegrini, K. Schindler, D. Nardi, "A generalisation of the ICP algorithm for articulated bodies", BMVC 2008.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix, diags, identity
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from geomocap.model.point_grid import PointGrid
from geomocap.nodes.correspondences import Target, pull
from geomocap.nodes.node_graph import NodeGraph
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.part_grouping import MotionForms, group_nodes
from geomocap.nodes.part_motion import RigidParts, carry_samples, part_equations, part_motions
from geomocap.nodes.part_selection import choose_parts, follow_bearings, touching, without_weakest
from geomocap.scheduling import map_items

_FORM_SCALE = 0.6  # node spacings
_MISFIT_SCALE = 0.3  # node spacings; points farther along the surface, or facing elsewhere, are others
_ACROSS = 0.15  # distance from the points' planes that counts as a miss, node spacings
_SPARSE = 4 / 3  # points are no farther apart than so many of the least scale
_ALONG = 0.01  # weight of a distance along the surface relative to one across it
_UNSEEN = 0.05  # least weight of a sample that no point supports
_RESTING_FRAMES = 0.95  # a node may rest if points suit it in so many of the frames,
_RESTING_SUPPORT = 0.7  # and support it so well, relative to how it was followed
_RESTING_FRACTION = 0.05  # least fraction of the nodes that rest side by side
_LOOKED_AT = 10  # frames that say which part a node follows
_FIRST = (0.8, 0.6, 0.5, 0.4, 0.4, 0.3)  # node spacings
_AGAIN = (0.5, 0.4, 0.3)
_LAST_STEPS = 2  # of them, after the best start is known
_THINNED = 2  # before, one sample in so many is looked at
_ASTRAY = 0.01  # a part leaves the motion it had in the frame before for one that misses less by so much
_FORMS = ("R", "t", "form", "slope", "cost", "weight")


class PartTracker:
    """Frames and reference surface, to which parts are fitted."""

    def __init__(self, graph: NodeGraph, targets: Sequence[Target], closest: float, settings: NodeTrackingSettings):
        """Take the frames' points, their normals turned outwards; `closest` is the least scale, metres."""
        self.graph, self.targets, self.closest, self.settings = graph, targets, closest, settings
        c = max(_MISFIT_SCALE * graph.spacing, closest)
        self.grids = [PointGrid.of(np.hstack([p.points.positions, c * p.points.normals])) for p in targets]
        self.owner = graph.binding[np.arange(len(graph.samples)), graph.weights.argmax(axis=1)]
        N = len(graph.nodes)
        i, j = graph.edges.T
        near = csr_matrix((np.ones(len(i)), (i, j)), (N, N))
        self.near = csr_matrix(near + near.T + identity(N))
        self.mean = csr_matrix(diags(1 / np.asarray(self.near.sum(axis=1)).ravel()) @ self.near)

    def find(self, x: np.ndarray, R: np.ndarray, reference: int, each: Callable[..., list]) -> RigidParts:
        """Find the parts of nodes at x (N, T, 3) with rotations R (N, T, 3, 3), and their motions.

        What may rest does: of a shaft that stands still below another, nothing is seen of whether it turns with it.
        `each(function, frames)` calls a function for each frame.
        """
        g, s = self.graph, self.settings
        frames = list(range(x.shape[1]))
        least = max(4, round(s.part_fraction * len(g.nodes)))
        forms = _stack(each(lambda k: self.forms(k, x[:, k], R[:, k]), frames))
        unmoved = np.broadcast_to(np.eye(3), R[:, 0].shape)
        at_rest = _stack(each(lambda k: self.forms(k, g.nodes, unmoved, along=1.0), frames))
        still = self.resting(forms, at_rest)
        label = group_nodes(_either(still, at_rest, forms), g.edges, s.part_misfit * g.spacing, least)
        rests = 2 * np.bincount(label, still) > np.bincount(label)
        parts = part_motions(label, g.nodes, x, R, 0.3 * g.spacing).at_rest(rests)
        for scales in (_FIRST, _AGAIN)[: s.part_rounds]:
            parts = self.follow(parts, reference, scales, each)
            for _ in range(2):
                # a node may belong to the parts of nodes two edges away
                allowed = (self.near @ (self.near @ np.eye(len(parts.R))[parts.label])) > 0
                chosen = choose_parts(parts.label, self.costs(parts, allowed, each), parts.rests, self.mean)
                parts = replace(parts, label=chosen).compact()
            if parts.rests.any():
                parts = self.needed(parts, each)
        return parts

    def needed(self, parts: RigidParts, each: Callable[..., list]) -> RigidParts:
        """Leave out parts that are not needed, one after the other, and let flat round solids turn with what they bear.

        That is for machines on a base, whose parts are hard: what is soft bends within a part, and needs them all.
        """
        edges = self.graph.edges
        while len(parts.R) > 1:
            beside = touching(parts.label, edges, len(parts.R))
            label = without_weakest(parts.label, self.costs(parts, beside[parts.label], each), beside, parts.rests)
            if label is None:
                break
            parts = replace(parts, label=label).compact()
        beside = touching(parts.label, edges, len(parts.R))
        cost = self.costs(parts, beside[parts.label], each)
        return replace(
            parts, label=follow_bearings(parts.label, cost, parts.R, parts.t, parts.rests, self.graph)
        ).compact()

    def follow(
        self, parts: RigidParts, reference: int, scales: Sequence[float], each: Callable[..., list]
    ) -> RigidParts:
        """Register the parts to frame after frame, from the reference frame on, forwards and backwards.

        Each part starts from where it is expected, where it was last, and where it was followed, and takes what misses
        fewest points: a bar that turns on a disc sticks to it as a skin, but from the frame before it finds its place.
        """
        R, t = parts.R.copy(), parts.t.copy()
        R[:, reference], t[:, reference] = np.eye(3), 0.0
        middles = _means(self.graph.nodes, parts.label, len(R))
        own = parts.label[self.owner]
        sample = np.arange(len(own))

        def one_way(way: int) -> None:
            for k in range(reference + way, R.shape[1] if way > 0 else -1, way):
                now, last = k - way, k - way * min(2, abs(k - reference))
                expected = _expected(R[:, now], t[:, now], R[:, last], t[:, last], middles)
                starts = [expected, (R[:, now], t[:, now]), (parts.R[:, k], parts.t[:, k])]
                found = [self.register(k, parts, *start, scales[:-_LAST_STEPS], _THINNED) for start in starts]
                missed = np.stack([_mean_of(self.misses(k, *motion, sample, own), own, len(R)) for motion in found])
                missed[-1] += _ASTRAY
                best, rows = missed.argmin(axis=0), np.arange(len(R))
                chosen_R, chosen_t = (np.stack([f[i] for f in found])[best, rows] for i in (0, 1))
                R[:, k], t[:, k] = self.register(k, parts, chosen_R, chosen_t, scales[-_LAST_STEPS:])

        each(one_way, [1, -1])
        return replace(parts, R=R, t=t)

    def resting(self, forms: MotionForms, at_rest: MotionForms) -> np.ndarray:
        """Nodes (N,) that points suit as well if they stay where they are, `at_rest`, as the way they were followed."""
        N, T = forms.weight.shape
        weight, followed = np.maximum(at_rest.weight, 1e-6), np.maximum(forms.weight, 1e-6)
        worst = int(np.ceil(_RESTING_FRAMES * (T - 1)))  # all of a few frames
        more = np.sort(at_rest.cost / weight - forms.cost / followed, axis=1)[:, worst]
        support = np.sort(at_rest.weight / followed, axis=1)[:, T - 1 - worst]
        still = (more < (self.settings.part_misfit * self.graph.spacing) ** 2) & (support > _RESTING_SUPPORT)
        still = self.mean @ still.astype(float) > 0.5
        beside = connected_components(self.near[still][:, still], directed=False)[1]
        still[still] = np.bincount(beside)[beside] >= _RESTING_FRACTION * N
        return still

    def costs(self, parts: RigidParts, allowed: np.ndarray, each: Callable[..., list]) -> np.ndarray:
        """What it costs nodes to follow parts, `allowed` (N, B): 0 to 1, infinite where not allowed, (N, B)."""
        T = parts.R.shape[1]
        sample, part = np.nonzero(allowed[self.owner])
        frames = list(range(0, T, max(1, T // _LOOKED_AT)))
        missed = each(lambda k: self.misses(k, parts.R[:, k], parts.t[:, k], sample, part), frames)
        total, count = np.zeros(allowed.shape), np.zeros(allowed.shape)
        np.add.at(total, (self.owner[sample], part), np.mean(missed, axis=0))
        np.add.at(count, (self.owner[sample], part), 1)
        cost = np.where(count > 0, total / np.maximum(count, 1), 1.0)
        return np.where(allowed, 0.5 * cost + 0.5 * (self.mean @ cost), np.inf)

    def forms(self, frame: int, x: np.ndarray, R: np.ndarray, along: float = _ALONG) -> MotionForms:
        """What a frame's points know of the motion of each node; lengths in metres.

        `along` is the weight of a motion along the surface relative to one across it.
        """
        g, target = self.graph, self.targets[frame]
        c = max(_FORM_SCALE * g.spacing, self.closest)
        y, normals = g.deform(x, R)
        distance, found = target.grid(c).query(target.search_coordinates(y, normals, g.features, c))
        w = np.exp(-0.5 * (distance / c) ** 2)
        n = target.points.normals[found]
        off = ((y - target.points.positions[found]) * n).sum(axis=1)
        across = np.concatenate([np.cross(y, n), n], axis=1)
        moves = np.concatenate([-_cross_matrix(y), np.broadcast_to(np.eye(3), (len(y), 3, 3))], axis=2)
        form = w[:, None, None] * across[:, :, None] * across[:, None]
        form += (along * np.maximum(w, _UNSEEN))[:, None, None] * (moves.swapaxes(1, 2) @ moves)
        N = len(x)
        sums = [np.zeros((N, *shape)) for shape in ((6, 6), (6,), (), ())]
        for total, part in zip(sums, (form, (w * off)[:, None] * across, w * off**2, w), strict=True):
            np.add.at(total, self.owner, part)
        sums[0] += 1e-9 * np.eye(6)
        return MotionForms(R, x - (R @ g.nodes[..., None])[..., 0], *sums)

    def covariance(self, frame: int, parts: RigidParts) -> np.ndarray:
        """Covariance of each node's position (N, 3, 3), m², as its part's points know the part's motion.

        What they don't know of it is free to slide, with the settings' standard deviation.
        """
        floor, slide = (np.array([self.settings.noise, self.settings.slide]) * self.graph.spacing) ** 2
        label, R = parts.label, parts.R[parts.label, frame]
        x = (R @ self.graph.nodes[..., None])[..., 0] + parts.t[label, frame]
        forms = self.forms(frame, x, R, along=0.0)
        moves = np.concatenate([-_cross_matrix(x), np.broadcast_to(np.eye(3), (len(x), 3, 3))], axis=2)
        sums = []
        for of_nodes in (forms.form, moves.swapaxes(1, 2) @ moves, forms.cost, forms.weight, np.ones(len(x))):
            sums.append(np.zeros((len(parts.R), *of_nodes.shape[1:])))
            np.add.at(sums[-1], label, of_nodes)
        form, free, cost, weight, count = sums
        variance = cost / np.maximum(weight, 1.0) + floor
        of_motion = np.linalg.inv(form / variance[:, None, None] + free / (count * slide)[:, None, None])
        return moves @ of_motion[label] @ moves.swapaxes(1, 2) + floor * np.eye(3)

    def misses(self, frame: int, R: np.ndarray, t: np.ndarray, sample: np.ndarray, part: np.ndarray) -> np.ndarray:
        """How far samples (n,) are from a frame's surface if carried by parts (n,), robustly, 0 to 1.

        The surface is that of the nearest points' planes, as far as these points are near: where on a surface its
        points lie is chance. R (B, 3, 3) and t (B, 3) are the parts' motions.
        """
        g, points = self.graph, self.targets[frame].points
        c = max(_MISFIT_SCALE * g.spacing, self.closest)
        y = (R[part] @ g.samples[sample][..., None])[..., 0] + t[part]
        n = (R[part] @ g.normals[sample][..., None])[..., 0]
        found = self.grids[frame].query(np.hstack([y, c * n]), reach=3 * c)[1]
        none = found == len(points)
        found[none] = 0
        off, facing = y - points.positions[found], points.normals[found]
        across = (off * facing).sum(axis=1)
        along = np.sqrt(np.maximum((off**2).sum(axis=1) - across**2, 0.0))
        beyond = np.maximum(along - _SPARSE * self.closest, 0.0)
        squared = (across / (_ACROSS * g.spacing)) ** 2 + (beyond / c) ** 2 + ((n - facing) ** 2).sum(axis=1)
        return np.where(none, 1.0, 1 - np.exp(-0.5 * squared))

    def register(
        self, frame: int, parts: RigidParts, R: np.ndarray, t: np.ndarray, scales: Sequence[float], every: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Fit the parts' motions to a frame, from R (B, 3, 3), t (B, 3) on; at borders, parts hold each other.

        Of the samples and the frame's points, one in `every` is used.
        """
        g, s, label = self.graph, self.settings, parts.label
        target = replace(self.targets[frame], points=self.targets[frame].points.every(every))
        samples, normals, features, binding, weights = (
            a[::every] for a in (g.samples, g.normals, g.features, g.binding, g.weights)
        )
        free = np.repeat(~parts.rests, 6)
        apart = label[g.edges[:, 0]] != label[g.edges[:, 1]]
        hinges = g.edges[apart]
        firm = s.fine_stiffness * s.stiffness * len(samples) / len(g.nodes) / 4
        for scale in scales:
            c = max(scale * g.spacing, self.closest)
            y, turned = carry_samples(R, t, label, samples, normals, binding, weights)
            found = pull(target, y, turned, features, c, _ALONG, s.feature_weight)
            x = (R[label] @ g.nodes[..., None])[..., 0] + t[label]
            hold = firm / (1 + (g.strain(x, R[label])[apart] / s.give) ** 2) ** 2
            middle = _means(x, label, len(R))
            H, b = part_equations(
                R, t, middle, label, samples, binding, weights, found.A, found.b, g.nodes, hinges, hold
            )
            damping = 1e-3 * np.bincount(label, minlength=len(R))[:, None] * ([g.spacing**2] * 3 + [1.0] * 3)
            step = np.zeros((len(R), 6))
            step.ravel()[free] = np.linalg.solve((H + np.diag(damping.ravel()))[np.ix_(free, free)], b.ravel()[free])
            much = np.maximum(np.linalg.norm(step[:, :3], axis=1, keepdims=True) / 0.5, 1.0)
            turn = Rotation.from_rotvec(step[:, :3] / much).as_matrix()
            t = (turn @ (t - middle)[..., None])[..., 0] + middle + step[:, 3:]
            R = turn @ R
        return R, t


def find_rigid_parts(
    graph: NodeGraph,
    targets: Sequence[Target],
    x: np.ndarray,
    R: np.ndarray,
    reference: int,
    closest: float,
    settings: NodeTrackingSettings,
    executor: Executor,
) -> tuple[RigidParts, np.ndarray]:
    """Group the nodes of a tracked surface into rigid parts and register these to all frames.

    Parameters
    ----------
    graph : NodeGraph
    targets : sequence of Target
        Points of each frame.
    x, R : (N, T, 3), (N, T, 3, 3) float
        Nodes as they were followed.
    reference : int
        The frame from which motions are counted.
    closest : float, metres
        Least distance at which a point loses its weight.
    settings : NodeTrackingSettings
    executor : Executor

    Returns
    -------
    parts : RigidParts
    covariance : (N, T, 3, 3) float, m²
        Of the nodes' positions.
    """

    def turned(frame: int) -> Target:
        surface = graph.deform(x[:, frame], R[:, frame])
        return replace(targets[frame], points=targets[frame].points.turned_like(*surface, 0.5 * graph.spacing))

    def each(work: Callable, frames: list[int]) -> list:
        return list(map_items(work, frames, executor))

    tracker = PartTracker(graph, each(turned, list(range(len(targets)))), closest, settings)
    parts = tracker.find(x, R, reference, each)
    return parts, np.stack(each(lambda k: tracker.covariance(k, parts), list(range(len(targets)))), axis=1)


def _stack(forms: list[MotionForms]) -> MotionForms:
    return MotionForms(*(np.stack([getattr(f, name) for f in forms], axis=1) for name in _FORMS))


def _either(chosen: np.ndarray, first: MotionForms, second: MotionForms) -> MotionForms:
    """The first's forms of the nodes chosen, (N,) bool, the second's of the others."""
    pairs = ((getattr(first, name), getattr(second, name)) for name in _FORMS)
    return MotionForms(*(np.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


def _expected(
    R: np.ndarray, t: np.ndarray, before_R: np.ndarray, before_t: np.ndarray, middles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Go on as from the motion before (B, 3, 3), (B, 3): the same turn about the middles (B, 3), the same shift."""
    turn = R @ before_R.swapaxes(1, 2) @ R
    now, last = (np.einsum("bij,bj->bi", a, middles) + b for a, b in ((R, t), (before_R, before_t)))
    return turn, 2 * now - last - np.einsum("bij,bj->bi", turn, middles)


def _mean_of(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    return np.bincount(group, values, count) / np.maximum(np.bincount(group, minlength=count), 1)


def _means(x: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    total = np.zeros((count, 3))
    np.add.at(total, label, x)
    return total / np.maximum(np.bincount(label, minlength=count), 1)[:, None]


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]ₓ, (n, 3, 3)."""
    K = np.zeros((len(v), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return K - K.transpose(0, 2, 1)
