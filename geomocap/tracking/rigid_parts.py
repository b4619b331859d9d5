"""A surface followed as rigid parts: its nodes grouped by their motion, and the parts registered to all frames.

Deformed as a skin, a hard part is held by a few points near each of its nodes; moved as one, by all of its shape, which
is what keeps it from sliding. Labels and motions are found in turns, as in articulated iterative closest points: S.
Pellegrini, K. Schindler, D. Nardi, "A generalisation of the ICP algorithm for articulated bodies", BMVC 2008.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix, identity
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geomocap.scheduling import map_items
from geomocap.tracking.correspondences import Target, pull
from geomocap.tracking.deformation import rotation_of
from geomocap.tracking.node_graph import NodeGraph
from geomocap.tracking.node_settings import NodeTrackingSettings
from geomocap.tracking.part_grouping import MotionForms, group_nodes

_FORM_SCALE = 0.6  # node spacings
_MISFIT_SCALE = 0.3
_ALONG = 0.01  # weight of a distance along the surface relative to one across it
_UNSEEN = 0.05  # least weight of a sample that no point supports
_RESTING_FRAMES = 0.95  # a node may rest if points suit it in so many of the frames,
_RESTING_SUPPORT = 0.7  # and support it so well, relative to how it was followed
_RESTING_SHARE = 0.05  # least share of the nodes that rest side by side
_TOGETHER = 0.025  # what it costs a node to be of another part than all its neighbours, as a share of being off
_RINGS = 2  # a node may belong to the parts of nodes so many edges away
_FIRST = (0.8, 0.6, 0.5, 0.4)  # node spacings
_AGAIN = (0.5, 0.4, 0.3)
_FORMS = ("R", "t", "form", "slope", "cost", "weight")


@dataclass(frozen=True)
class RigidParts:
    """B rigid parts of a surface of N nodes in T frames.

    Attributes
    ----------
    label : (N,) int
        Part of each node.
    R, t : (B, T, 3, 3), (B, T, 3) float, metres
        position = R @ reference + t.
    rests : (B,) bool
        Parts that stay where they are in all frames, as a robot's base does.
    """

    label: np.ndarray
    R: np.ndarray
    t: np.ndarray
    rests: np.ndarray

    def carry(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, T, 3) and rotations (N, T, 3, 3) of nodes (N, 3)."""
        R = self.R[self.label]
        return (R @ nodes[:, None, :, None])[..., 0] + self.t[self.label], R

    def at_rest(self, rests: np.ndarray) -> RigidParts:
        """Let parts rest, (B,) bool."""
        turns = np.where(rests[:, None, None, None], np.eye(3), self.R)
        return RigidParts(self.label, turns, np.where(rests[:, None, None], 0.0, self.t), rests)


class PartTracker:
    """Frames and reference surface, to which parts are fitted."""

    def __init__(self, graph: NodeGraph, targets: Sequence[Target], closest: float, settings: NodeTrackingSettings):
        """Take the frames' points, their normals turned outwards; `closest` is the least scale, metres."""
        self.graph, self.targets, self.closest, self.settings = graph, targets, closest, settings
        self.owner = graph.binding[np.arange(len(graph.samples)), graph.weights.argmax(axis=1)]
        N = len(graph.nodes)
        i, j = graph.edges.T
        near = csr_matrix((np.ones(len(i)), (i, j)), (N, N))
        self.near = csr_matrix(near + near.T + identity(N))
        self.near_count = np.asarray(self.near.sum(axis=1))

    def find(self, x: np.ndarray, R: np.ndarray, each: Callable[..., list]) -> RigidParts:
        """Find the parts of nodes at x (N, T, 3) with rotations R (N, T, 3, 3), and their motions.

        What may rest does: of a shaft that stands still below another, nothing is seen of whether it turns with it.
        `each(function, frames)` calls a function for each frame.
        """
        g, s = self.graph, self.settings
        frames = list(range(x.shape[1]))
        least = max(4, round(s.part_share * len(g.nodes)))
        forms = _stack(each(lambda k: self.forms(k, x[:, k], R[:, k]), frames))
        unmoved = np.broadcast_to(np.eye(3), R[:, 0].shape)
        at_rest = _stack(each(lambda k: self.forms(k, g.nodes, unmoved, along=1.0), frames))
        still = self.resting(forms, at_rest)
        label = group_nodes(_either(still, at_rest, forms), g.edges, s.part_misfit * g.spacing, least)
        rests = 2 * np.bincount(label, still) > np.bincount(label)
        parts = part_motions(label, g.nodes, x, R, 0.3 * g.spacing).at_rest(rests)
        for scales in (_FIRST, _AGAIN)[: s.part_rounds]:
            parts = self._settled(parts, x, R, each, frames)
            moved = each(lambda k, p=parts, c=scales: self.register(k, p, c), frames)
            parts = replace(parts, R=np.stack([m[0] for m in moved], 1), t=np.stack([m[1] for m in moved], 1))
            x, R = parts.carry(g.nodes)
        return self._settled(parts, x, R, each, frames)

    def resting(self, forms: MotionForms, at_rest: MotionForms) -> np.ndarray:
        """Nodes (N,) that points suit as well if they stay where they are, `at_rest`, as the way they were followed."""
        N, T = forms.weight.shape
        weight, followed = np.maximum(at_rest.weight, 1e-6), np.maximum(forms.weight, 1e-6)
        worst = int(_RESTING_FRAMES * (T - 1))
        more = np.sort(at_rest.cost / weight - forms.cost / followed, axis=1)[:, worst]
        support = np.sort(at_rest.weight / followed, axis=1)[:, T - 1 - worst]
        still = (more < (self.settings.part_misfit * self.graph.spacing) ** 2) & (support > _RESTING_SUPPORT)
        still = 2 * (self.near @ still.astype(float)) > self.near_count.ravel()
        beside = connected_components(self.near[still][:, still], directed=False)[1]
        still[still] = np.bincount(beside)[beside] >= _RESTING_SHARE * N
        return still

    def _settled(
        self, parts: RigidParts, x: np.ndarray, R: np.ndarray, each: Callable[..., list], frames: list[int]
    ) -> RigidParts:
        """Let each node belong to the part near it whose motion suits it and its neighbours best."""
        near = np.zeros((len(x), len(parts.R)))
        near[np.arange(len(x)), parts.label] = 1.0
        for _ in range(_RINGS):
            near = self.near @ near
        allowed = near > 0
        sample, part = np.nonzero(allowed[self.owner])
        miss = np.mean(each(lambda k: self.misses(k, parts, sample, part), frames), axis=0)
        total, count = np.zeros(allowed.shape), np.zeros(allowed.shape)
        np.add.at(total, (self.owner[sample], part), miss)
        np.add.at(count, (self.owner[sample], part), 1)
        cost = np.where(count > 0, total / np.maximum(count, 1), 1.0)
        cost = np.where(count > 0, 0.5 * cost + 0.5 * (self.near @ cost) / self.near_count, np.inf)
        label = parts.label
        nothing_known = ~np.isfinite(cost).any(axis=1)
        for _ in range(3):
            beside = (self.near @ np.eye(len(parts.R))[label]) / self.near_count
            label = np.where(nothing_known, label, (cost - _TOGETHER * beside).argmin(axis=1))
        kept, label = np.unique(label, return_inverse=True)
        return part_motions(label, self.graph.nodes, x, R, 0.3 * self.graph.spacing).at_rest(parts.rests[kept])

    def forms(self, frame: int, x: np.ndarray, R: np.ndarray, along: float = _ALONG) -> MotionForms:
        """What a frame's points know of the motion of each node; lengths in metres.

        `along` is the weight of a motion along the surface relative to one across it.
        """
        g, target = self.graph, self.targets[frame]
        c = max(_FORM_SCALE * g.spacing, self.closest)
        y, normals = g.deform(x, R)
        distance, found = cKDTree(target.coordinates(c)).query(target.search_coordinates(y, normals, g.features, c))
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

    def misses(self, frame: int, parts: RigidParts, sample: np.ndarray, part: np.ndarray) -> np.ndarray:
        """How far samples (n,) are from a frame's points if carried by parts (n,), robustly, 0 to 1."""
        g, points = self.graph, self.targets[frame].points
        c = max(_MISFIT_SCALE * g.spacing, self.closest)
        R = parts.R[part, frame]
        y = (R @ g.samples[sample][..., None])[..., 0] + parts.t[part, frame]
        n = (R @ g.normals[sample][..., None])[..., 0]
        tree = cKDTree(np.hstack([points.positions, c * points.normals]))
        distance = tree.query(np.hstack([y, c * n]), distance_upper_bound=3 * c)[0]
        return 1 - np.exp(-0.5 * np.minimum(distance / c, 3.0) ** 2)

    def register(self, frame: int, parts: RigidParts, scales: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Fit the parts' motions R (B, 3, 3), t (B, 3) to a frame; at borders both parts hold on to each other."""
        g, s, target = self.graph, self.settings, self.targets[frame]
        label, R, t = parts.label, parts.R[:, frame], parts.t[:, frame]
        free = np.repeat(~parts.rests, 6)
        hinges = g.edges[label[g.edges[:, 0]] != label[g.edges[:, 1]]]
        lengths = np.linalg.norm(g.nodes[hinges[:, 0]] - g.nodes[hinges[:, 1]], axis=1)
        firm = s.fine_stiffness * s.stiffness * len(g.samples) / len(g.nodes) / 4
        for scale in scales:
            c = max(scale * g.spacing, self.closest)
            x = (R[label] @ g.nodes[..., None])[..., 0] + t[label]
            y, normals = g.deform(x, R[label])
            tree = cKDTree(target.coordinates(c))
            found = pull(target, tree, y, normals, g.features, c, _ALONG, s.feature_weight)
            strain = g.strain(x, R[label])[label[g.edges[:, 0]] != label[g.edges[:, 1]]] if len(lengths) else lengths
            hold = firm / (1 + (strain / s.give) ** 2) ** 2
            middle = _means(x, label, len(R))
            H, b = part_equations(
                R, t, middle, label, g.samples, g.binding, g.weights, found.A, found.b, g.nodes, hinges, hold
            )
            damping = 1e-3 * np.bincount(label, minlength=len(R))[:, None] * ([g.spacing**2] * 3 + [1.0] * 3)
            step = np.zeros((len(R), 6))
            step.ravel()[free] = np.linalg.solve((H + np.diag(damping.ravel()))[np.ix_(free, free)], b.ravel()[free])
            much = np.maximum(np.linalg.norm(step[:, :3], axis=1, keepdims=True) / 0.5, 1.0)
            turn = rotation_of(step[:, :3] / much)
            t = (turn @ (t - middle)[..., None])[..., 0] + middle + step[:, 3:]
            R = turn @ R
        return R, t


@njit(cache=True, nogil=True)
def part_equations(R, t, middle, label, samples, binding, weights, A, b, nodes, hinges, hold):
    """Normal equations H (6B, 6B), right side (6B,) of the parts' steps: turn about the middle, and shift.

    Parameters
    ----------
    R, t, middle : (B, 3, 3), (B, 3), (B, 3) float
        Motions since the reference, and centres of the parts in the frame.
    label : (N,) int
        Parts of the nodes.
    samples, binding, weights : (S, 3), (S, K), (S, K)
        Samples in the reference, the nodes that carry them, and their shares.
    A, b : (S, 3, 3), (S, 3) float
        Weights of the samples' positions, and weights times errors.
    nodes : (N, 3) float
        In the reference.
    hinges : (E, 2) int
        Pairs of nodes of different parts: both parts carry both nodes to the same places, with weight `hold` (E,).
    """
    B = len(R)
    H = np.zeros((6 * B, 6 * B))
    g = np.zeros(6 * B)
    K = binding.shape[1]
    J = np.zeros((K, 3, 6))
    AJ = np.zeros((3, 6))
    part = np.empty(K, np.int64)
    for s in range(len(samples) + 2 * len(hinges)):
        hinge = s >= len(samples)
        if hinge:
            e, side = (s - len(samples)) // 2, (s - len(samples)) % 2
            p = nodes[hinges[e, side]]
            used = 2
        else:
            e, side = 0, 0
            p = samples[s]
            used = K
        e0, e1, e2 = 0.0, 0.0, 0.0
        for k in range(used):
            if hinge:
                part[k] = label[hinges[e, k]]
                w = 1.0 - 2.0 * k
            else:
                part[k] = label[binding[s, k]]
                w = weights[s, k]
            q = part[k]
            y0 = R[q, 0, 0] * p[0] + R[q, 0, 1] * p[1] + R[q, 0, 2] * p[2] + t[q, 0]
            y1 = R[q, 1, 0] * p[0] + R[q, 1, 1] * p[1] + R[q, 1, 2] * p[2] + t[q, 1]
            y2 = R[q, 2, 0] * p[0] + R[q, 2, 1] * p[1] + R[q, 2, 2] * p[2] + t[q, 2]
            e0, e1, e2 = e0 + w * y0, e1 + w * y1, e2 + w * y2
            a0, a1, a2 = w * (y0 - middle[q, 0]), w * (y1 - middle[q, 1]), w * (y2 - middle[q, 2])
            # dy/dturn = −[a]ₓ, dy/dshift = w
            J[k, 0, 1], J[k, 0, 2], J[k, 0, 3] = a2, -a1, w
            J[k, 1, 0], J[k, 1, 2], J[k, 1, 4] = -a2, a0, w
            J[k, 2, 0], J[k, 2, 1], J[k, 2, 5] = a1, -a0, w
        for k in range(used):
            first = 6 * part[k]
            for n in range(6):
                if hinge:
                    g[first + n] -= hold[e] * (J[k, 0, n] * e0 + J[k, 1, n] * e1 + J[k, 2, n] * e2)
                    for m in range(3):
                        AJ[m, n] = hold[e] * J[k, m, n]
                else:
                    g[first + n] -= J[k, 0, n] * b[s, 0] + J[k, 1, n] * b[s, 1] + J[k, 2, n] * b[s, 2]
                    for m in range(3):
                        AJ[m, n] = A[s, m, 0] * J[k, 0, n] + A[s, m, 1] * J[k, 1, n] + A[s, m, 2] * J[k, 2, n]
            for h in range(used):
                second = 6 * part[h]
                for m in range(6):
                    for n in range(6):
                        H[second + m, first + n] += (
                            J[h, 0, m] * AJ[0, n] + J[h, 1, m] * AJ[1, n] + J[h, 2, m] * AJ[2, n]
                        )
    return H, g


def part_motions(label: np.ndarray, nodes: np.ndarray, x: np.ndarray, R: np.ndarray, arm: float) -> RigidParts:
    """Fit rigid motions to groups of nodes by Kabsch's method; a node's rotation counts as points `arm` metres from it.

    Parameters
    ----------
    label : (N,) int
    nodes, x, R : (N, 3), (N, T, 3), (N, T, 3, 3) float
        Reference positions, positions and rotations.
    """
    B, T = int(label.max()) + 1, x.shape[1]
    turns, shifts = np.empty((B, T, 3, 3)), np.empty((B, T, 3))
    for b in range(B):
        own = label == b
        start, middle = nodes[own].mean(axis=0), x[own].mean(axis=0)
        moment = np.einsum("ntc,nd->tcd", x[own] - middle, nodes[own] - start) + arm**2 * R[own].sum(axis=0)
        U, _, Vt = np.linalg.svd(moment)
        U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
        turns[b] = U @ Vt
        shifts[b] = middle - turns[b] @ start
    return RigidParts(label, turns, shifts, np.zeros(B, bool))


def find_rigid_parts(
    graph: NodeGraph,
    targets: Sequence[Target],
    x: np.ndarray,
    R: np.ndarray,
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
    parts = tracker.find(x, R, each)
    return parts, np.stack(each(lambda k: tracker.covariance(k, parts), list(range(len(targets)))), axis=1)


def _stack(forms: list[MotionForms]) -> MotionForms:
    return MotionForms(*(np.stack([getattr(f, name) for f in forms], axis=1) for name in _FORMS))


def _either(chosen: np.ndarray, first: MotionForms, second: MotionForms) -> MotionForms:
    """The first's forms of the nodes chosen, (N,) bool, the second's of the others."""
    pairs = ((getattr(first, name), getattr(second, name)) for name in _FORMS)
    return MotionForms(*(np.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


def _means(x: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    total = np.zeros((count, 3))
    np.add.at(total, label, x)
    return total / np.maximum(np.bincount(label, minlength=count), 1)[:, None]


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]ₓ, (n, 3, 3)."""
    K = np.zeros((len(v), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return K - K.transpose(0, 2, 1)
