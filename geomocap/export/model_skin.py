"""The skin of a subject's own model, bound to a motion of its bodies."""

from __future__ import annotations

import numpy as np

from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.motion_tree import MotionTree
from geomocap.export.skin import node_of_body
from geomocap.export.skinned_mesh import INFLUENCES, SkinnedMesh
from geomocap.model.palette import body_colors
from geomocap.subject.model_mesh import model_mesh
from geomocap.subject.subject_model import SubjectModel


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
    mesh = model_mesh(model, settings.skin_triangles)
    surface, skin = mesh.surface, mesh.skin
    shape = (len(surface.vertices), INFLUENCES)
    nodes, fractions = np.zeros(shape, int), np.zeros(shape)
    most = skin.bodies.shape[1]
    nodes[:, :most] = node_of_body(motion, skin.bodies.ravel()).reshape(skin.bodies.shape)
    fractions[:, :most] = skin.fractions
    colors = mesh.colors if settings.skin_colors == "true" and len(mesh.colors) else body_colors(skin.body)
    return SkinnedMesh(surface.vertices, surface.normals, surface.triangles, colors, nodes, fractions, 0)
