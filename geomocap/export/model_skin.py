"""The skin of a subject's own model, bound to a motion of its bodies."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.motion_tree import MotionTree
from geomocap.export.skin import node_of_body
from geomocap.export.skinned_mesh import INFLUENCES, SkinnedMesh
from geomocap.model.palette import body_colors
from geomocap.model.surface import surface_through
from geomocap.skeleton.body_observations import SkinPoints
from geomocap.subject.subject_model import SubjectModel

NEAREST = 4  # points of the model that give a vertex its weights and colour


def skin_from_model(model: SubjectModel, motion: MotionTree, settings: ExportSettings) -> SkinnedMesh:
    """Mesh a model's surface, with its skin weights, in the motion's first frame.

    Parameters
    ----------
    model : SubjectModel
        Its rest pose is the motion's first frame.
    motion : MotionTree
    settings : ExportSettings

    Raises
    ------
    MotionError
        If the motion has other bodies, or the surface can't be made.
    """
    found = int(motion.bodies.max()) + 1
    if found != model.body_count:
        raise MotionError(
            f"skin: model.npz has {model.body_count} bodies, skeleton.npz {found}; run again, or --surface bones"
        )
    surface = surface_through(model.points, model.normals, settings.skin_triangles)
    distance, nearest = cKDTree(model.points).query(surface.vertices, min(NEAREST, len(model.points)))
    fraction = 1.0 / np.maximum(distance.reshape(len(nearest), -1), 1e-6)
    fraction /= fraction.sum(axis=1, keepdims=True)
    nearest = nearest.reshape(fraction.shape)
    weights = np.einsum("vk,vkb->vb", fraction, model.skin.weights(model.body_count)[nearest])
    skin = SkinPoints.of_weights(surface.vertices, weights)
    nodes, fractions = np.zeros((len(weights), INFLUENCES), int), np.zeros((len(weights), INFLUENCES))
    most = skin.bodies.shape[1]
    nodes[:, :most] = node_of_body(motion, skin.bodies.ravel()).reshape(skin.bodies.shape)
    fractions[:, :most] = skin.fractions
    if settings.skin_colors == "true" and len(model.colors):
        colors = np.rint(np.einsum("vk,vkc->vc", fraction, model.colors[nearest].astype(float))).astype(np.uint8)
    else:
        colors = body_colors(skin.body)
    return SkinnedMesh(surface.vertices, surface.normals, surface.triangles, colors, nodes, fractions, 0)
