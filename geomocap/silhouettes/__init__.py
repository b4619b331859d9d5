"""Background model of a camera, and the silhouettes of what stands before it."""

from geomocap.silhouettes.background import BackgroundModel, model_from_frames, model_from_plate
from geomocap.silhouettes.extraction import coverage, silhouette
from geomocap.silhouettes.region import region_of_box, region_of_points
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

__all__ = [
    "BackgroundModel",
    "SilhouetteSettings",
    "coverage",
    "model_from_frames",
    "model_from_plate",
    "region_of_box",
    "region_of_points",
    "silhouette",
]
