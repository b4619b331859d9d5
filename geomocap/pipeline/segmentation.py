"""Stage: frame geometry → ellipsoids, rigid bodies and skeleton: `ellipsoids.npz`, `bodies/`, `skeleton.npz`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from geomocap.errors import GeometryError
from geomocap.geometry import BodyPoints, Voxels, read_cloud
from geomocap.pipeline.clouds import clouds
from geomocap.pipeline.job import Job
from geomocap.pipeline.voxels import voxels
from geomocap.run import Run, stage_key
from geomocap.scans import point_spacing
from geomocap.scheduling import map_items
from geomocap.segmentation.m3 import segment_m3
from geomocap.segmentation.segmentation import Segmentation
from geomocap.skeleton.skeleton import skeleton_m3

Source = Literal["voxels", "cloud", "scans"]


class Geometry(Protocol):
    """A sequence of point sets, wherever they come from."""

    @property
    def spacing(self) -> float:
        """Distance of neighbouring points, metres."""
        ...

    def __len__(self) -> int: ...

    def points(self, frame: int) -> np.ndarray:
        """Points of one frame, (N, 3) float, metres, world."""
        ...


@dataclass(frozen=True)
class VoxelFrames:
    """The surface voxels of a run."""

    run: Run
    frames: int

    @property
    def spacing(self) -> float:
        """Edge of a voxel, metres."""
        return Voxels.read(self.run.frame_file("voxels", 0)).voxel_size

    def __len__(self) -> int:
        return self.frames

    def points(self, frame: int) -> np.ndarray:
        """Voxel centres of one frame, (N, 3) float, metres, world."""
        return Voxels.read(self.run.frame_file("voxels", frame)).points


@dataclass(frozen=True)
class CloudFrames:
    """The measured surface points of a run."""

    run: Run
    frames: int

    @property
    def spacing(self) -> float:
        """Mean distance of a point of the first cloud from its nearest neighbour, metres."""
        return point_spacing(self.points(0))

    def __len__(self) -> int:
        return self.frames

    def points(self, frame: int) -> np.ndarray:
        """Points of one frame, (N, 3) float, metres, world."""
        return read_cloud(self.run.frame_file("cloud", frame))


def geometry_of(job: Job, source: Source) -> tuple[Geometry, str]:
    """Make the geometry that a source names, and return it with the key of the stage that made it."""
    if source == "scans":
        if job.scans is None:
            raise GeometryError("no scans were given")
        return job.scans, stage_key("scans", job.scans.fingerprint(), job.config.scans.model_dump())
    key = voxels(job) if source == "voxels" else clouds(job)
    assert job.capture is not None
    frames = job.capture.n_frames
    return VoxelFrames(job.run, frames) if source == "voxels" else CloudFrames(job.run, frames), key


def segment(job: Job, source: Source) -> str:
    """Find ellipsoids, bodies and skeleton; return the stage's key."""
    geometry, source_key = geometry_of(job, source)
    settings = job.config.segmentation.model_dump(), job.config.skeleton.model_dump()
    outputs = ["ellipsoids.npz", "bodies", "diagnostics.npz", "skeleton.npz"]
    if len(geometry) == 1:  # a single frame has no motion to tell bodies and joints by
        outputs.remove("skeleton.npz")
    key = stage_key("segmentation", source_key, settings, job.fps)
    return job.stage("segmentation", key, outputs, lambda: _segment(job, geometry))


def _segment(job: Job, geometry: Geometry) -> int:
    frames = len(geometry)
    found = segment_m3(
        geometry.points,
        frames,
        spacing=geometry.spacing,
        settings=job.config.segmentation,
        executor=job.executor,
        progress=job.progress,
    )
    write = _WriteBodies(geometry, job.run, found)
    for _ in map_items(write, range(frames), job.executor, "bodies", job.progress):
        pass
    job.run.write_npz("ellipsoids.npz", **found.arrays())
    if frames > 1:
        with job.run.timed("skeleton") as count:
            skeleton = skeleton_m3(found, job.fps, job.config.skeleton)
            job.run.write_npz("skeleton.npz", **skeleton.arrays())
            count["items"] = frames
    job.run.write_npz(
        "diagnostics.npz",
        integrals=found.integrals,
        threshold=found.threshold,
        seeds=found.seeds,
        repaired=found.repaired,
        touching=found.touching,
        body=found.body,
    )
    return frames


@dataclass(frozen=True)
class _WriteBodies:
    """Points of one frame with their bodies, written to the run."""

    geometry: Geometry
    run: Run
    found: Segmentation

    def __call__(self, frame: int) -> None:
        points = BodyPoints(self.geometry.points(frame), self.found.body_labels(frame))
        points.write(self.run.frame_file("bodies", frame))
