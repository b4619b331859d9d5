"""A posed surface against the silhouettes: where it ends in an image, the silhouette should end, too.

A place of the surface that is seen at its edge lies in the plane through the camera and the tangent of the outline
there; nothing is said of where along it. Both directions are asked, so that neither what the surface leaves uncovered
nor what it covers too much is overlooked (Gall et al., Motion capture using joint skeleton tracking and surface
estimation, CVPR 2009, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.outline_points import OutlinePoints
from geomocap.model.ray_casting import TriangleScene
from geomocap.scheduling import map_here
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.subject.model_mesh import ModelMesh

# A surface may end at a vertex up to this cosine between normal and viewing ray, if nothing is drawn so many pixels
# further outwards. With 0.35 and 3 pixels, vertices within the edge count, and models grow: of a man's silhouettes
# 3.4 % were drawn beside and 1.1 % not, instead of 2.5 and 1.7; overlap 0.955 instead of 0.959.
_GRAZING = 0.2
_BEYOND = 1.5
_FEWEST = 5  # places of an edge that are matched
# Of the drawn diagonal, up to which edges and outlines are paired. 0.05 and 0.1: a person before four real cameras,
# whose arms were placed badly, overlapped by 0.844 and 0.854, twelve joints 90 and 88 mm from the markers; a man
# before four cameras, stag, bird, dwarf and horse by 0.926 and 0.926 on average, joints 92 mm off both
_REACH = 0.1
_TURN = 0.05  # of the drawn diagonal that a difference of directions of one radian counts as
_PIXELS = 1.5  # standard deviation of an outline, at least
# Fraction of the pairs that err independently of each other. With 0.3 (6e5b991) rotations of thirteen hard captures
# were 9.5° off instead of 9.1 on average, and a person's joints, four real cameras, 64 mm instead of 65.
_INDEPENDENCE = 0.1
_ALONG = 1e-3  # weight of distances in the tangent plane: what nothing else tells stays where it is
_NORMAL = 1.4826  # standard deviations of normal errors in their median
_NONE = (np.zeros(0, int), np.zeros(0, int), np.zeros((0, 4)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class OutlinePairs:
    """M vertices at edges of a surface drawn in T frames, and the planes that they should lie in, sorted by frame.

    Attributes
    ----------
    start : (T + 1,) int
        Pairs of frame t are those from start[t] to start[t + 1].
    camera, vertex : (M,) int
    plane : (M, 4) float
        Unit normal out of the silhouette, and offset, metres, world.
    away : (M,) float, metres
        By how much the vertex is outside.
    pixel : (M,) float, metres
        What a pixel covers there.
    """

    start: np.ndarray
    camera: np.ndarray
    vertex: np.ndarray
    plane: np.ndarray
    away: np.ndarray
    pixel: np.ndarray

    @property
    def typical(self) -> np.ndarray:
        """Standard deviation of the distances, robust, that each pair's camera has over all frames: (M,) metres."""
        count = int(self.camera.max(initial=-1)) + 1
        each = [np.abs(self.away[self.camera == c]) for c in range(count)]
        return np.array([_NORMAL * float(np.median(a)) if len(a) else 0.0 for a in each])[self.camera]

    def observations(self, skin: SkinPoints, bodies: BodyMotion) -> Observations:
        """Observations of the points `skin`, the vertices at rest, in a motion.

        An outline counts by how well its camera's outlines and the surface agree: a camera whose silhouettes err says
        less.
        """
        weight = _INDEPENDENCE / ((_PIXELS * self.pixel) ** 2 + self.typical**2)
        target = np.empty((len(self.vertex), 3))
        for t, (a, b) in enumerate(pairwise(self.start)):
            some = self.vertex[a:b]
            part = bodies.part(slice(t, t + 1))
            place = part.carry(skin.rest[some], skin.bodies[some], skin.fractions[some])[0]
            normal, offset = self.plane[a:b, :3], self.plane[a:b, 3]
            target[a:b] = place - ((normal * place).sum(axis=1) + offset)[:, None] * normal
        along = _ALONG * weight
        return Observations(self.start, self.vertex.astype(np.int32), target, self.plane[:, :3].copy(), along, weight)


def match_outlines(surface: ModelMesh, bodies: BodyMotion, outlines: OutlinePoints) -> OutlinePairs:
    """Pair the edges of a surface, drawn in all frames, with the outlines.

    Parameters
    ----------
    surface : ModelMesh
        At rest.
    bodies : BodyMotion
        T frames.
    outlines : OutlinePoints
        Of the same frames.
    """
    frames = map_here(lambda t: _match_frame(surface, bodies, outlines, t), range(outlines.frames))
    start = np.concatenate([[0], np.cumsum([len(frame[0]) for frame in frames])])
    return OutlinePairs(start, *(np.concatenate(column) for column in zip(*frames, strict=True)))


def _match_frame(surface: ModelMesh, bodies: BodyMotion, outlines: OutlinePoints, frame: int) -> tuple[np.ndarray, ...]:
    """Cameras, vertices, planes, distances and pixels of one frame's pairs."""
    part, skin, triangles = bodies.part(slice(frame, frame + 1)), surface.skin, surface.surface.triangles
    places = part.carry(skin.rest, skin.bodies, skin.fractions)[0]
    normals = np.einsum("vij,vj->vi", part.rotations[0, skin.body], surface.surface.normals)
    scene = TriangleScene(places, triangles, threads=1)
    found: list[tuple[np.ndarray, ...]] = [_NONE]
    for c, (P, points) in enumerate(zip(outlines.projections, outlines.points[frame], strict=True)):
        pairs = _match(places, normals, scene, P, outlines.centers[c], np.asarray(points, float))
        found.append((np.full(len(pairs[0]), c), *pairs))
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def _match(
    places: np.ndarray,
    normals: np.ndarray,
    scene: TriangleScene,
    P: np.ndarray,
    center: np.ndarray,
    outline: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Pairs of one camera, P (3, 4), with its outline (M, 4): vertices, planes, distances and pixels."""
    pixels, depth = _project(P, places)
    if not len(outline) or not (depth > 0).all():
        return _NONE[1:]
    pixel = depth / np.sqrt(abs(np.linalg.det(P[:, :3])))
    edge, outward = _edge(places, normals, scene, P, center, pixels, pixel)
    if len(edge) < _FEWEST:
        return _NONE[1:]
    diagonal = float(np.linalg.norm(np.ptp(pixels, axis=0)))
    mine, theirs = (
        np.hstack([place, _TURN * diagonal * direction])
        for place, direction in ((pixels[edge], outward), (outline[:, :2], outline[:, 2:]))
    )
    there, nearest = cKDTree(mine).query(theirs, distance_upper_bound=_REACH * diagonal)
    back, nearest_back = cKDTree(theirs).query(mine, distance_upper_bound=_REACH * diagonal)
    there, back = np.isfinite(there), np.isfinite(back)
    vertex = np.concatenate([edge[nearest[there]], edge[back]])
    at = outline[np.concatenate([np.flatnonzero(there), nearest_back[back]])]
    line = np.column_stack([at[:, 2:], -(at[:, :2] * at[:, 2:]).sum(axis=1)])
    plane = line @ P  # through the camera and the tangent of the outline
    plane /= np.linalg.norm(plane[:, :3], axis=1, keepdims=True)
    return vertex, plane, (plane[:, :3] * places[vertex]).sum(axis=1) + plane[:, 3], pixel[vertex]


def _edge(
    places: np.ndarray,
    normals: np.ndarray,
    scene: TriangleScene,
    P: np.ndarray,
    center: np.ndarray,
    pixels: np.ndarray,
    pixel: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at which the drawn surface ends, (E,) int, and the directions outwards in the image, (E, 2)."""
    rays = places - center
    cosine = (normals * rays).sum(axis=1) / np.linalg.norm(rays, axis=1)
    grazing = np.flatnonzero(np.abs(cosine) < _GRAZING)
    beyond = places[grazing] + _BEYOND * pixel[grazing, None] * normals[grazing]
    towards = beyond - center
    free = ~scene.occluded(np.hstack([np.broadcast_to(center, towards.shape), towards]))
    edge = grazing[free]
    outward = _project(P, beyond[free])[0] - pixels[edge]
    return edge, outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)


def _project(P: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    at = points @ P[:, :3].T + P[:, 3]
    return at[:, :2] / at[:, 2:], at[:, 2]
