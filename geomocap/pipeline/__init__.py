"""The stages of a run in their order, each doing first what it needs and is missing or out of date."""

from geomocap.files.results import read_cloud_record
from geomocap.pipeline.camera_stage import agreeing
from geomocap.pipeline.cloud_stage import clouds
from geomocap.pipeline.export_stage import motion_files
from geomocap.pipeline.job import Job
from geomocap.pipeline.segmentation_stage import segment
from geomocap.pipeline.silhouette_stage import silhouettes
from geomocap.pipeline.track_stage import tracks
from geomocap.pipeline.voxel_stage import voxels

__all__ = [
    "Job",
    "agreeing",
    "clouds",
    "motion_files",
    "read_cloud_record",
    "segment",
    "silhouettes",
    "tracks",
    "voxels",
]
