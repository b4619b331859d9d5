"""Surface measurement: the images of one frame become a point cloud."""

from geomocap.cloud.frame import CloudFrame, TemplateCloud, cloud_of_frame
from geomocap.cloud.groups import MatchGroup, MatchGroups, match_groups
from geomocap.cloud.images import undistorted_color
from geomocap.cloud.points import MeasuredPoints
from geomocap.cloud.settings import CloudSettings

__all__ = [
    "CloudFrame",
    "CloudSettings",
    "MatchGroup",
    "MatchGroups",
    "MeasuredPoints",
    "TemplateCloud",
    "cloud_of_frame",
    "match_groups",
    "undistorted_color",
]
