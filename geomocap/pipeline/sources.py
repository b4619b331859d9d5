"""Where the geometry of a run comes from: surface voxels, measured clouds, or anybody's scans."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from geomocap.carving.visibility import enclosing_normals
from geomocap.errors import GeometryError
from geomocap.files.frame_files import read_points, read_voxels
from geomocap.files.run import Run, stage_key
from geomocap.model.frame_geometry import Geometry
from geomocap.model.surface import point_spacing
from geomocap.pipeline.cloud_stage import clouds
from geomocap.pipeline.job import Job
from geomocap.pipeline.voxel_stage import voxels

Source = Literal["voxels", "cloud", "scans"]


@dataclass(frozen=True)
class VoxelFrames:
    """The surface voxels of a run."""

    run: Run
    frames: int

    @property
    def spacing(self) -> float:
        """Edge of a voxel, metres."""
        return read_voxels(self.run.frame_file("voxels", 0)).voxel_size

    def __len__(self) -> int:
        return self.frames

    def points(self, frame: int) -> np.ndarray:
        """Voxel centres of one frame, (N, 3) float, metres, world."""
        return read_voxels(self.run.frame_file("voxels", frame)).points

    def features(self, frame: int) -> np.ndarray:
        """Colours of the voxels, (N, 3) float, 0 to 1."""
        return read_voxels(self.run.frame_file("voxels", frame)).colors / 255.0

    def normals(self, frame: int) -> np.ndarray:
        """Outward unit normals of the voxels, (N, 3) float, by what they enclose."""
        return enclosing_normals(read_voxels(self.run.frame_file("voxels", frame)).indices)


@dataclass(frozen=True)
class CloudFrames:
    """The measured surface points of a run."""

    run: Run
    frames: int

    @property
    def spacing(self) -> float:
        """Mean distance of a point of the first cloud from its nearest neighbour, metres."""
        return point_spacing(self.points(0), np.mean)

    def __len__(self) -> int:
        return self.frames

    def points(self, frame: int) -> np.ndarray:
        """Points of one frame, (N, 3) float, metres, world."""
        return read_points(self.run.frame_file("cloud", frame)).positions

    def features(self, frame: int) -> np.ndarray:
        """Colours of the points, (N, 3) float, 0 to 1."""
        return _known(self.run.frame_file("cloud", frame), "colors", "colours") / 255.0

    def normals(self, frame: int) -> np.ndarray:
        """Unit normals of the points, (N, 3) float, on the side of the cameras that saw them."""
        return _known(self.run.frame_file("cloud", frame), "normals", "normals")


def _known(path: Path, what: Literal["colors", "normals"], called: str) -> np.ndarray:
    found: np.ndarray | None = getattr(read_points(path), what)
    if found is None:
        raise GeometryError(f"{path}: its points have no {called}; delete it and run again")
    return found


def geometry_of(job: Job, source: Source) -> tuple[Geometry, str]:
    """Make the geometry that a source names, and return it with the key of the stage that made it."""
    if source == "scans":
        if job.scans is None:
            raise GeometryError("no scans were given")
        settings = job.config.scans.model_dump(exclude={"up"})  # the points are the same
        return job.scans, stage_key(__name__, "scans", job.scans.fingerprint(), settings)
    key = voxels(job) if source == "voxels" else clouds(job)
    assert job.capture is not None
    frames = job.capture.n_frames
    return VoxelFrames(job.run, frames) if source == "voxels" else CloudFrames(job.run, frames), key
