"""Surface measurement: the images of one frame become a point cloud."""

from geomocap.dense.dense_frame import CloudFrame, TemplateCloud, cloud_of_frame, measure_cloud
from geomocap.dense.dense_settings import CloudSettings
from geomocap.dense.match_groups import MatchGroup, MatchGroups, match_groups
from geomocap.dense.matching_images import undistorted_color
from geomocap.dense.measured_points import MeasuredPoints

__all__ = [
    "CloudFrame",
    "CloudSettings",
    "MatchGroup",
    "MatchGroups",
    "MeasuredPoints",
    "TemplateCloud",
    "cloud_of_frame",
    "match_groups",
    "measure_cloud",
    "undistorted_color",
]
