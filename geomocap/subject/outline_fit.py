"""Motion and shape of a subject's model, so that it ends in the images where the silhouettes do.

Where few cameras see a place of the surface, paths know little of how deep it lies, and all that is found from them is
off by that; the silhouettes of the other cameras know. Motion and shape are found by turns: what the surface misses in
all frames alike is its shape's fault, what it misses in some is the motion's (Cheung, Baker, Kanade,
Shape-from-silhouette across time, 2005; Gall et al., Motion capture using joint skeleton tracking and surface
estimation, 2009). A model of voxels' middles is half a voxel too small: left so, it turns its bodies to meet one side
of the outlines (those of a man before four cameras by 4.3° instead of 3.4).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.outline_points import OutlinePoints
from geomocap.model.surface import Surface
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.skeleton.motion_skeleton import MotionSkeleton
from geomocap.subject.model_building import rebuilt_model
from geomocap.subject.model_mesh import NEAREST, ModelMesh
from geomocap.subject.outline_matching import OutlinePairs, match_outlines
from geomocap.subject.subject_model import SubjectModel

_AROUND = 40  # vertices over which the shape's error is averaged
_SAME_SIDE = 0.5  # cosine between normals of these
_DOUBT = 20  # observations of no error that each place's error is averaged with
_FARTHEST = 3.0  # standard deviations; what is farther off counts as that


class OutlineFit:
    """What outlines say of a motion, in the rounds of a refinement.

    Parameters
    ----------
    surface : ModelMesh
        At rest.
    outlines : OutlinePoints
        Of all frames.
    """

    def __init__(self, surface: ModelMesh, outlines: OutlinePoints) -> None:
        self.surface = surface
        self._outlines = outlines
        self._start = surface.skin.rest
        self._outside = np.zeros(len(surface.skin.rest))  # by which the surface was too large there, metres
        self._pose: BodyMotion | None = None

    def observe(self, bodies: BodyMotion) -> tuple[SkinPoints, Observations]:
        """Correct the shape, and return its vertices and where outlines have them."""
        pairs = match_outlines(self.surface, bodies, self._outlines)
        error = shape_errors(self.surface, pairs)
        self._outside += error
        shape = self.surface.surface
        rest = shape.vertices - error[:, None] * shape.normals
        skin = replace(self.surface.skin, rest=rest)
        self.surface = ModelMesh(Surface(rest, shape.normals, shape.triangles), skin, self.surface.colors)
        return skin, pairs.observations(skin, bodies)

    def settle(self, pose: BodyMotion) -> None:
        """Take note of the pose, a single frame, that is the rest pose from here on."""
        self._pose = pose

    def model(self, before: SubjectModel, found: MotionSkeleton) -> SubjectModel:
        """Return the model that the surface was made from with the shape, and of the refined skeleton, found."""
        assert self._pose is not None
        nearest = cKDTree(self._start).query(before.points, NEAREST)[1]
        inward = self._outside[nearest].mean(axis=1)[:, None] * before.normals
        skin = before.skin
        points = self._pose.carry(skin.rest - inward, skin.bodies, skin.fractions)[0]
        normals = np.einsum("pij,pj->pi", self._pose.rotations[0, skin.body], before.normals)
        return rebuilt_model(before, found, points, normals)


def shape_errors(surface: ModelMesh, pairs: OutlinePairs) -> np.ndarray:
    """By how much a surface is too large at its vertices, over all frames and cameras: (V,) float, metres."""
    skin, normals = surface.skin, surface.surface.normals
    most = _FARTHEST * pairs.typical
    away = np.clip(pairs.away, -most, most)
    count, total = (np.bincount(pairs.vertex, w, len(skin)) for w in (np.ones(len(away)), away))
    near = cKDTree(skin.rest).query(skin.rest, min(_AROUND, len(skin)))[1].reshape(len(skin), -1)
    alike = skin.body[near] == skin.body[:, None]
    alike &= np.einsum("vki,vi->vk", normals[near], normals) > _SAME_SIDE
    return (total[near] * alike).sum(axis=1) / ((count[near] * alike).sum(axis=1) + _DOUBT)
