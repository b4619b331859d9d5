"""A model's surface as a closed mesh whose vertices follow the bodies as its points do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.surface import Surface, surface_through
from geomocap.skeleton.body_observations import SkinPoints
from geomocap.subject.subject_model import SubjectModel

DRAWN_TRIANGLES = 20_000  # of a model that is drawn to be compared with silhouettes, at most
NEAREST = 4  # points of the model that give a vertex its weights and colour


@dataclass(frozen=True)
class ModelMesh:
    """A skinned mesh at rest.

    Attributes
    ----------
    surface : Surface
        V vertices.
    skin : SkinPoints
        The vertices with their skin weights.
    colors : (V, 3) uint8 or (0, 3)
        RGB; none if the model has none.
    """

    surface: Surface
    skin: SkinPoints
    colors: np.ndarray


def model_mesh(model: SubjectModel, max_triangles: int = 50000) -> ModelMesh:
    """Mesh a model's surface, with its skin weights and colours.

    Raises
    ------
    MotionError
        If the surface can't be made.
    """
    surface = surface_through(model.points, model.normals, max_triangles)
    distance, nearest = cKDTree(model.points).query(surface.vertices, min(NEAREST, len(model.points)))
    fraction = 1.0 / np.maximum(distance.reshape(len(nearest), -1), 1e-6)
    fraction /= fraction.sum(axis=1, keepdims=True)
    nearest = nearest.reshape(fraction.shape)
    weights = np.einsum("vk,vkb->vb", fraction, model.skin.weights(model.body_count)[nearest])
    colors = np.zeros((0, 3), np.uint8)
    if len(model.colors):
        colors = np.rint(np.einsum("vk,vkc->vc", fraction, model.colors[nearest].astype(float))).astype(np.uint8)
    return ModelMesh(surface, SkinPoints.of_weights(surface.vertices, weights), colors)
