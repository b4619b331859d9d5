"""Background model of a camera, and the silhouettes of what stands before it, as all cameras decide together."""

from geomocap.silhouettes.background import BackgroundModel, model_from_frames, model_from_plate
from geomocap.silhouettes.joint_decision import Decision, View, coverage, decide, learn_from, silhouette
from geomocap.silhouettes.likelihood import Counts, Likelihood
from geomocap.silhouettes.other_cameras import OtherCameras
from geomocap.silhouettes.region import region_of_box, region_of_points
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

__all__ = [
    "BackgroundModel",
    "Counts",
    "Decision",
    "Likelihood",
    "OtherCameras",
    "SilhouetteSettings",
    "View",
    "coverage",
    "decide",
    "learn_from",
    "model_from_frames",
    "model_from_plate",
    "region_of_box",
    "region_of_points",
    "silhouette",
]
