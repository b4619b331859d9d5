"""Tracking nodes of a surface through a sequence of point sets that are sampled afresh in each frame."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.rotations import nearest_rotation
from geomocap.nodes.anchors import AnchorPoints, Anchors
from geomocap.nodes.coarse_motion import CoarseModel, CoarseTarget, State, follow, mend
from geomocap.nodes.correspondences import Target, pull
from geomocap.nodes.deformation import block_pattern, step
from geomocap.nodes.edge_stiffness import learned_stiffness
from geomocap.nodes.extremities import extremities
from geomocap.nodes.image_motion import ImageMotion, NodeState
from geomocap.nodes.image_pull import FrameImages, Views
from geomocap.nodes.keyframes import most_open, openness
from geomocap.nodes.node_graph import farthest_points, largest_parts, node_graph
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_uncertainty import carried_sigma, node_covariance, patch_mean, with_departure
from geomocap.nodes.rigid_parts import find_rigid_parts
from geomocap.nodes.surface_points import PointSet, point_set, surface_graph
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items, threads

Points = Callable[[int], np.ndarray]
"""Points of a frame, (M, 3) float, metres; or their features, (M, F) float."""

NodeFit = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Places, rotations and covariances of the nodes in a frame, and which are lost."""

FINE = ((1.0, 2.0), (0.8, 1.0), (0.6, 1.0), (0.6, 1.0))
"""Scales in node spacings and stiffness of the fine fit, step by step."""
USUAL_NOISE = 0.035
"""Median distance of a visual hull from the surface that fits it, node spacings."""
END_SIZE = 0.12
"""How far an end of a limb stands out, fraction of the diagonal."""


@dataclass(frozen=True)
class NodeTracks:
    """Tracked nodes.

    Attributes
    ----------
    positions : (N, T, 3) float, metres, world
        NaN where a node is lost.
    rotations : (N, T, 3, 3) float
        Rotation of the surface around each node since the reference frame, world axes.
    covariance : (N, T, 3, 3) float, m²
        Of the positions: large along directions in which the surface may slide unseen.
    reference_frame : int
    reference : (N, 3) float, metres
        Positions in the reference frame, complete.
    edges : (E, 2) int
        Neighbours on the surface.
    departure : (N, T) float, metres
        Distance of each node from where its neighbours would have it, as followed as a skin: large where it, or they,
        went astray.
    spacing : float, metres
        Mean distance of neighbours.
    parts : (N,) int, optional
        Rigid part of each node, if they were followed as parts.
    """

    positions: np.ndarray
    rotations: np.ndarray
    covariance: np.ndarray
    reference_frame: int
    reference: np.ndarray
    edges: np.ndarray
    departure: np.ndarray
    spacing: float
    parts: np.ndarray | None = None

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of a coordinate, root mean square of the three directions, (N, T) float, metres."""
        return np.sqrt(np.trace(self.covariance, axis1=2, axis2=3) / 3)

    def motion_paths(self, anchors: MotionPaths | None = None) -> MotionPaths:
        """Return the nodes as motion paths, those that are never seen left out.

        Without their rotations: how a node's neighbours turn about it is steadier than how it turns itself. Motion is
        counted from frame 0: from the reference frame, which is one in the middle, what turns on and on would turn by
        half as much.

        Parameters
        ----------
        anchors : MotionPaths, optional
            What held the nodes in the images; with `sigma`. The nodes are then as precise as these carry them.
        """
        seen = np.isfinite(self.positions[..., 0]).any(axis=1)
        parts = None if self.parts is None else np.unique(self.parts[seen], return_inverse=True)[1]
        positions, sigma = self.positions[seen], self.sigma[seen]
        if anchors is not None:
            sigma = with_departure(carried_sigma(positions, anchors), self.departure[seen], self.spacing)
        return MotionPaths(positions, sigma=sigma, parts=parts)


@dataclass(frozen=True)
class Unit:
    """Length and place by which points are tracked alike in whatever unit and wherever they are.

    Attributes
    ----------
    length : float, metres
        A power of two, so that scaling by it is exact: more than half the points' diagonal, at most all of it.
    origin : (3,) float, metres
    """

    length: float
    origin: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Unit:
        """Unit of points (M, 3), M ≥ 0."""
        if not len(points):
            return cls(1.0, np.zeros(3))
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
        length = 2.0 ** np.floor(np.log2(diagonal)) if diagonal > 0 else 1.0
        return cls(length, np.round(points.mean(axis=0) / length) * length)

    def to(self, points: np.ndarray) -> np.ndarray:
        """Points (…, 3) in metres, in this unit."""
        return (points - self.origin) / self.length

    def back(self, points: np.ndarray) -> np.ndarray:
        """Points (…, 3) in this unit, in metres."""
        return self.length * points + self.origin


class NodeModel:
    """The reference surface with its coarse and its fine graph."""

    def __init__(self, surface: PointSet, settings: NodeTrackingSettings):
        self.settings = settings
        graph = surface_graph(surface.positions, surface.normals, 8)
        kept = np.flatnonzero(largest_parts(graph, 0.01))
        surface, graph = surface.at(kept), graph[kept][:, kept]
        chosen = farthest_points(surface.positions, settings.nodes)
        coarse = chosen[: min(settings.coarse_nodes, len(chosen))]
        self.graph = node_graph(surface, graph, chosen, 4 * settings.nodes)
        self.pattern = block_pattern(self.graph)
        self.patches = patch_mean(self.graph)
        carried = node_graph(surface, graph, coarse, len(surface))
        self.spacing = float(np.median(cKDTree(surface.positions).query(surface.positions, 2)[0][:, 1]))
        diagonal = float(np.linalg.norm(np.ptp(surface.positions, axis=0)))
        ends = surface.positions[extremities(graph, END_SIZE * diagonal)]
        coarse_graph = node_graph(surface, graph, coarse, 6 * len(coarse))
        self.coarse = CoarseModel.of(coarse_graph, ends, self.spacing, settings)
        # fine nodes hang on the coarse graph as its samples do
        where = cKDTree(carried.samples).query(self.graph.nodes)[1]
        self.carrier, self.carrier_weights = carried.binding[where], carried.weights[where]

    def refine(
        self, target: Target, coarse: State, homes: np.ndarray, anchors: Anchors, frame: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Fit the fine graph to a frame from the coarse state; positions, rotations, covariances, which are lost.

        `homes` (P, 3) are where the anchors are in the reference frame, NaN where not known.
        """
        arm = self.graph.nodes[:, None] - self.coarse.graph.nodes[self.carrier]
        moved = coarse.x[self.carrier] + np.matmul(coarse.R[self.carrier], arm[..., None])[..., 0]
        w = self.carrier_weights
        x = (w[..., None] * moved).sum(axis=1)
        R = nearest_rotation((w[..., None, None] * coarse.R[self.carrier]).sum(axis=1))
        h, s, g = self.graph.spacing, self.settings, self.graph
        target = replace(target, points=target.points.turned_like(*g.deform(x, R), 0.5 * h))
        marks = AnchorPoints.of(g, homes, anchors, frame)
        for scale, stiffness in FINE:
            c = max(scale * h, 1.5 * self.spacing)
            y, normals = g.deform(x, R)
            found = pull(target, y, normals, g.features, c, s.point_weight, s.feature_weight)
            marks.add_to(found.A, found.b, g, x, R, s.anchor_weight, c)
            soft = 1 / (1 + (g.strain(x, R) / s.give) ** 2) ** 2
            fraction = len(g.samples) / len(g.nodes) / 4
            # points that lie well on a surface are believed more than those of a rough hull
            rough = float(np.median(np.abs(found.across))) / (USUAL_NOISE * h)
            firm = stiffness * s.fine_stiffness * min(max(rough, 0.25), 1.0)
            x, R = step(g, self.pattern, x, R, firm * fraction * soft, found.A, found.b, 60)
        anchored = np.bincount(marks.sample, minlength=len(g.samples)).astype(float)
        return x, R, *self.held(target, x, R, anchored)

    def held(
        self, target: Target, x: np.ndarray, R: np.ndarray, anchored: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """How a frame's points, and anchors at the samples (S,), hold nodes: covariances (N, 3, 3), which are lost."""
        g, s, h = self.graph, self.settings, self.graph.spacing
        c = max(FINE[-1][0] * h, 1.5 * self.spacing)
        y, normals = g.deform(x, R)
        found = pull(replace(target), y, normals, g.features, c, s.point_weight, 0.0)
        covariance, support = node_covariance(
            self.patches, normals, found.support, found.across, s.slide * h, s.noise * h, anchored
        )
        return covariance, support < s.lost_below

    def held_in_images(self, target: Target, x: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `held`; nodes farther than a spacing from where their neighbours have them are lost too.

        A spinning dwarf had 12.8 instead of 15.0 bodies of 10 (four choices of the paths), a galloping stag 14.6
        instead of 14.8 of 15 (five).
        """
        covariance, lost = self.held(target, x, R)
        return covariance, lost | (self.graph.departure(x, R) > self.graph.spacing)

    def image_motion(self, geometric: list[NodeState]) -> ImageMotion:
        """Return what follows the fine graph in images too, as firm as the geometry alone has shown it to be."""
        s = self.settings
        stiffness = s.image_stiffness * learned_stiffness(self.graph, geometric)
        return ImageMotion(self.graph, self.pattern, self.spacing, stiffness, s.give, s.strain_cost, s.point_weight)


def track_nodes(
    points: Points,
    n_frames: int,
    settings: NodeTrackingSettings | None = None,
    features: Points | None = None,
    progress: Progress = silent,
    executor: Executor | None = None,
    anchors: MotionPaths | None = None,
    images: Callable[[int], Views] | None = None,
    normals: Points | None = None,
) -> NodeTracks:
    """Follow nodes of a surface through all frames, forwards and backwards from the most open one.

    Parameters
    ----------
    points : callable
        `points(frame) -> (M, 3) float`, metres, in any order and sampled afresh in each frame.
    n_frames : int
    settings : NodeTrackingSettings, optional
    features : callable, optional
        `features(frame) -> (M, F) float`, what else is known of each point, such as its colour between 0 and 1.
    progress : callable, optional
    executor : Executor, optional
        Threads; the cores' number of them if not given.
    anchors : MotionPaths, optional
        P points of the surface whose paths are known from elsewhere: nodes near them do not slide.
    images : callable, optional
        `images(frame)`, what the cameras see: nodes move as it does.
    normals : callable, optional
        `normals(frame) -> (M, 3) float`, outward unit normals of the points, 0 where unknown; from planes if not given.

    Raises
    ------
    GeometryError
        If there are no frames or a frame has too few points.
    """
    settings = settings or NodeTrackingSettings()
    if n_frames < 1:
        raise GeometryError("nodes can't be tracked through a sequence without frames")
    if executor is None:
        with threads() as own:
            return track_nodes(points, n_frames, settings, features, progress, own, anchors, images, normals)
    unit = Unit.of(np.asarray(points(0), float))

    def prepare(frame: int) -> PointSet:
        more = None if features is None else features(frame)
        found = unit.to(np.asarray(points(frame), float))
        # dense points are averaged over as much of the surface as few points are
        neighbours = max(settings.neighbours, min(len(found), 3 * settings.points) * 5 // (2 * settings.nodes))
        try:
            outward = None if normals is None else normals(frame)
            return point_set(found, settings.points, neighbours, settings.seed + frame, more, outward)
        except GeometryError as error:
            raise GeometryError(f"frame {frame}: {error}; check this frame's geometry") from None

    frames = list(map_items(prepare, list(range(n_frames)), executor, "points", progress))
    candidates = list(range(0, n_frames, max(1, n_frames // 30)))

    def judge(frame: int) -> float:
        return openness(surface_graph(frames[frame].positions, frames[frame].normals, 8))

    reference = most_open(list(map_items(judge, candidates, executor)), candidates, n_frames)
    scales = np.full(frames[reference].features.shape[1], settings.feature_scale)
    model = NodeModel(frames[reference], settings)
    diagonal = float(np.linalg.norm(np.ptp(frames[reference].positions, axis=0)))

    def coarsen(frame: int) -> CoarseTarget:
        few = frames[frame].thinned(settings.coarse_points, settings.seed + frame)
        graph = surface_graph(few.positions, few.normals, 8)
        kept = np.flatnonzero(largest_parts(graph, 0.01))
        few, graph = few.at(kept), graph[kept][:, kept]
        return CoarseTarget(
            Target(few, scales, settings.normal_weight), few.positions[extremities(graph, END_SIZE * diagonal)]
        )

    coarse = list(map_items(coarsen, list(range(n_frames)), executor, "ends of limbs", progress))
    known = Anchors.none(n_frames) if anchors is None else Anchors(unit.to(anchors.positions), ray=anchors.ray)
    (ahead, homes_ahead), (back, homes_back) = map_items(
        lambda way: follow(model.coarse, coarse, reference, way, known), [1, -1], executor, "coarse motion", progress
    )
    states = back[:0:-1] + ahead
    homes = [homes_back if frame < reference else homes_ahead for frame in range(n_frames)]
    marked = [model.coarse.marked(coarse[k], homes[k], known, k) for k in range(n_frames)]
    states = mend(model.coarse, marked, states, reference)

    def refine(frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        target = Target(frames[frame], scales, settings.normal_weight)
        return model.refine(target, states[frame], homes[frame], known, frame)

    fine = list(map_items(refine, list(range(n_frames)), executor, "nodes", progress))
    if images is not None:
        geometric = [(f[0], f[1]) for f in fine]
        measured = _measured(anchors, known, unit)
        fine = _followed_in_images(model, frames, geometric, reference, measured, images, unit, executor, progress)
    tracks = _tracks(model, fine, reference, unit)
    if settings.part_rounds and not len(known.positions) and images is None:
        targets = [Target(frame, scales, settings.normal_weight) for frame in frames]
        x, R = (np.stack([f[k] for f in fine], axis=1) for k in range(2))
        found, covariance = find_rigid_parts(
            model.graph, targets, x, R, reference, 1.5 * model.spacing, settings, executor
        )
        lost = np.isnan(tracks.positions)
        x, R = found.carry(model.graph.nodes)
        positions = np.where(lost, np.nan, unit.back(x))
        return replace(
            tracks, positions=positions, rotations=R, covariance=unit.length**2 * covariance, parts=found.label
        )
    return tracks


def _tracks(model: NodeModel, frames: list[NodeFit], reference: int, unit: Unit) -> NodeTracks:
    """Put the nodes' positions, rotations, covariances, and which are lost, of all frames together, in metres."""
    x, R, covariance, lost = (np.stack([f[k] for f in frames], axis=1) for k in range(4))
    x[lost] = np.nan
    g = model.graph
    departure = unit.length * np.stack([g.departure(f[0], f[1]) for f in frames], axis=1)
    spacing = unit.length * g.spacing
    places = unit.back(g.nodes)
    covariance = unit.length**2 * covariance
    return NodeTracks(unit.back(x), R, covariance, reference, places, g.edges, departure, spacing)


def _measured(anchors: MotionPaths | None, known: Anchors, unit: Unit) -> Anchors:
    """The same anchors with their precision; none if that isn't known."""
    if anchors is None or anchors.sigma is None:
        return Anchors.none(known.positions.shape[1])
    sigma = anchors.sigma if anchors.sigma.ndim == 2 else anchors.sigma[:, None]
    return replace(known, sigma=np.broadcast_to(sigma / unit.length, known.positions.shape[:2]))


def _followed_in_images(
    model: NodeModel,
    frames: list[PointSet],
    geometric: list[NodeState],
    reference: int,
    known: Anchors,
    images: Callable[[int], Views],
    unit: Unit,
    executor: Executor,
    progress: Progress,
) -> list[NodeFit]:
    """Follow the fine graph in points and images; positions, rotations, covariances, which are lost, of each frame."""
    settings = model.settings
    targets = [Target(f, np.full(f.features.shape[1], settings.feature_scale), settings.normal_weight) for f in frames]
    motion = model.image_motion(geometric)
    ahead, back = map_items(
        lambda way: motion.follow(
            targets,
            lambda k: FrameImages.of(images(k), unit.length, unit.origin),
            geometric,
            reference,
            way,
            known,
        ),
        [1, -1],
        executor,
        "motion in images",
        progress,
    )
    states = back[:0:-1] + ahead
    return [(x, R, *model.held_in_images(t, x, R)) for t, (x, R) in zip(targets, states, strict=True)]
