"""All settings in one TOML file: a table for each stage, every key with a default that works."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.carving.carving_settings import CarvingSettings
from geomocap.dense.dense_settings import CloudSettings
from geomocap.evaluation.camera_settings import CameraSettings
from geomocap.export.export_settings import ExportSettings
from geomocap.files.scan_settings import ScanSettings
from geomocap.model.windows import WindowSettings
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.segmentation.m3_settings import SegmentationSettings
from geomocap.segmentation.skeleton_settings import SkeletonSettings
from geomocap.settings import Settings, load_settings
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings
from geomocap.skeleton.motion_skeleton_settings import MotionSkeletonSettings, RefinementSettings
from geomocap.subject.following_settings import FollowingSettings
from geomocap.trajectories.trajectory_settings import FilterSettings, SmoothingSettings


class Config(Settings):
    """Settings of all stages."""

    cameras: CameraSettings = Field(CameraSettings(), description="check of the cameras")
    silhouettes: SilhouetteSettings = Field(SilhouetteSettings(), description="silhouettes")
    carving: CarvingSettings = Field(CarvingSettings(), description="space carving")
    cloud: CloudSettings = Field(CloudSettings(), description="surface measurement by least squares matching")
    scans: ScanSettings = Field(ScanSettings(), description="reading of scans")
    windows: WindowSettings = Field(WindowSettings(), description="windows of a long recording")
    segmentation: SegmentationSettings = Field(SegmentationSettings(), description="bodies")
    skeleton: SkeletonSettings = Field(SkeletonSettings(), description="joints and hierarchy")
    tracking: TrackingSettings = Field(TrackingSettings(), description="surface tracking in the images")
    filters: FilterSettings = Field(FilterSettings(), description="filters of trajectories")
    smoothing: SmoothingSettings = Field(SmoothingSettings(), description="velocities and accelerations")
    nodes: NodeTrackingSettings = Field(NodeTrackingSettings(), description="node tracking on the geometry")
    motion_bodies: MotionBodiesSettings = Field(MotionBodiesSettings(), description="bodies from motion paths")
    motion_skeleton: MotionSkeletonSettings = Field(MotionSkeletonSettings(), description="their joints")
    refinement: RefinementSettings = Field(RefinementSettings(), description="refinement of their motion")
    following: FollowingSettings = Field(
        FollowingSettings(), description="following a subject's model through another sequence"
    )
    export: ExportSettings = Field(ExportSettings(), description="motion files")


PREVIEW: dict[str, dict[str, Any]] = {
    "carving": {"resolution": 96},
    "tracking": {"n_patches": 1000},
    "windows": {"frames": 600},  # as many positions as 4,000 patches have in 150
    "motion_bodies": {"depth_rounds": 1},
    "refinement": {"rounds": 1},
    "following": {"points": 600},
    "export": {"skin_triangles": 10_000},
}
"""What a preview's small images can still tell, and what takes little time; what a user sets goes before it."""


def preview_config(config: Config) -> Config:
    """Return the settings of a preview: `PREVIEW` in place of what nobody has set."""
    tables = {}
    for name, values in PREVIEW.items():
        table = getattr(config, name)
        given = table.model_fields_set if name in config.model_fields_set else set()
        tables[name] = table.model_copy(update={k: v for k, v in values.items() if k not in given})
    return config.model_copy(update=tables)


def load_config(path: Path | None = None, overrides: dict[str, Any] | None = None) -> Config:
    """Read the settings from a TOML file, override single keys, and check them all.

    Parameters
    ----------
    path : Path, optional
        A settings file, or the `run.toml` of a run that is to be repeated.
    overrides : dict, optional
        Nested as the file is: `{section: {key: value}}`.

    Raises
    ------
    SettingsError
        If the file can't be read, a key is unknown or a value out of range.
    """
    return load_settings(Config, path, overrides)
