"""Space carving: silhouettes to coloured surface voxels."""

from geomocap.carving.agreement import check_agreement, check_cameras, check_inside, check_silhouettes
from geomocap.carving.carving_settings import CarvingSettings, ConsistencySettings, HullSettings
from geomocap.carving.frames import carve, carve_frame, needs_images
from geomocap.carving.hull import hull, hull_surface, visual_hull
from geomocap.carving.silhouette_views import PinholeViews, Undistortion, undistort_masks
from geomocap.carving.volume import working_volume
from geomocap.carving.voxel_grid import Grid

__all__ = [
    "CarvingSettings",
    "ConsistencySettings",
    "Grid",
    "HullSettings",
    "PinholeViews",
    "Undistortion",
    "carve",
    "carve_frame",
    "check_agreement",
    "check_cameras",
    "check_inside",
    "check_silhouettes",
    "hull",
    "hull_surface",
    "needs_images",
    "undistort_masks",
    "visual_hull",
    "working_volume",
]
