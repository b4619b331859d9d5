"""Refinement of a motion by silhouettes, on arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomocap.bodies.point_labels import Voters
from geomocap.errors import GeometryError
from geomocap.model.outline_points import OutlinePoints
from geomocap.motion import Motion
from geomocap.skeleton.motion_skeleton_settings import RefinementSettings
from geomocap.skeleton.refinement import refine_skeleton
from geomocap.subject.model_mesh import DRAWN_TRIANGLES, model_mesh
from geomocap.subject.outline_fit import OutlineFit
from geomocap.subject.subject_model import SubjectModel


def fit_to_outlines(
    motion: Motion,
    model: SubjectModel,
    outlines: OutlinePoints,
    *,
    settings: RefinementSettings | None = None,
    tracks: np.ndarray | None = None,
) -> tuple[Motion, SubjectModel]:
    """Refine a motion and the shape of its model so that this ends in the images where the silhouettes do.

    Parameters
    ----------
    motion : Motion
    model : SubjectModel
        Of this motion, as from `build_model`.
    outlines : OutlinePoints
        Of all its frames, as from `find_outlines`.
    settings : RefinementSettings, optional
        `outline_rounds` are done.
    tracks : (N, T, 3) float, metres, optional
        See `Motion.with_tracks`.

    Raises
    ------
    GeometryError
        If the outlines have another number of frames, or the model's points make no surface.
    """
    settings = settings or RefinementSettings()
    frames = len(motion.bodies.rotations)
    if outlines.frames != frames:
        raise GeometryError(f"outlines of {outlines.frames} frames, but the motion has {frames}; expected as many")
    if not settings.outline_rounds:
        return motion, model
    fit = OutlineFit(model_mesh(model, DRAWN_TRIANGLES), outlines)
    rounds = settings.model_copy(update={"rounds": settings.outline_rounds})
    connected, bodies = refine_skeleton(motion.connected, motion.bodies, motion.paths, rounds, fit)
    refined = replace(motion, connected=connected, bodies=bodies, voters=Voters.of(bodies, motion.paths))
    return (refined if tracks is None else refined.with_tracks(tracks)), fit.model(model, connected)
