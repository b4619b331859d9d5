"""The stages of a run in their order, each doing first what it needs and is missing or out of date."""

from geomocap.pipeline.clouds import clouds, read_cloud_record
from geomocap.pipeline.export import motion_files
from geomocap.pipeline.job import Job
from geomocap.pipeline.segmentation import segment
from geomocap.pipeline.silhouettes import silhouettes
from geomocap.pipeline.tracks import tracks
from geomocap.pipeline.voxels import voxels

__all__ = ["Job", "clouds", "motion_files", "read_cloud_record", "segment", "silhouettes", "tracks", "voxels"]
