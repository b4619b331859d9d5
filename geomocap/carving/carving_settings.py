"""Settings of space carving."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings

Point = tuple[float, float, float]

ENCLOSING = 4  # cameras that enclose a subject; the hull of fewer bounds nothing


class HullSettings(Settings):
    """When a voxel belongs to the visual hull."""

    outside: Literal["auto", "empty", "unseen"] = Field(
        default="auto",
        description="what a voxel outside a camera's view is for that camera: empty: background, as in the paper; "
        "unseen: that camera has no say; auto: unseen in the frames in which the camera's silhouette is cut off by the "
        "image's border; a camera whose silhouette is (nearly) empty has no say at all in that frame",
        json_schema_extra={"flag": "outside"},
    )
    min_views: int = Field(
        default=0,
        ge=0,
        description="cameras that must have a say of a voxel, where some may not see it (count); 0: half of those that "
        "see the subject, three at least",
    )
    tolerance: int = Field(default=0, ge=0, description="cameras that may call a voxel background and it stays (count)")
    phantoms: bool = Field(default=True, description="take away pieces of the hull that no silhouette needs")

    def views_of(self, cameras: int) -> int:
        """Return how many of so many cameras must have a say of a voxel."""
        return min(self.min_views or max(3, (cameras + 1) // 2), cameras)


class ConsistencySettings(Settings):
    """Colour consistency of the surface voxels."""

    enabled: bool = Field(
        default=True,
        description="carve surface voxels whose colours differ between the cameras",
        json_schema_extra={"flag": "color-consistency"},
    )
    threshold: float = Field(
        default=8.0, gt=0, description="colour deviation above which a voxel goes (grey values, 0–255)"
    )
    window: int = Field(
        default=0, ge=0, le=5, description="how far a projection may be off: radius of the window (pixels)"
    )
    min_cameras: int = Field(
        default=3, ge=2, description="cameras that must see a voxel before it can be judged (count)"
    )
    support: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="fraction of the judged surface voxels around it that must be inconsistent too (0–1)",
    )
    max_passes: int = Field(
        default=6, ge=1, le=1000, description="carving passes; each takes at most one layer of voxels (count)"
    )
    gain: bool = Field(default=True, description="estimate one brightness factor a camera and colour channel first")


class CarvingSettings(Settings):
    """From silhouettes to coloured surface voxels."""

    resolution: int = Field(
        default=256,
        ge=8,
        le=2048,
        description="voxels along the longest side of the subject, or of a given volume (count)",
        json_schema_extra={"flag": "resolution"},
    )
    voxel_size: float | None = Field(
        default=None,
        gt=0,
        description="edge of a voxel, instead of resolution (m)",
        json_schema_extra={"flag": "voxel-size"},
    )
    volume: tuple[Point, Point] | None = Field(
        default=None,
        description="corners (min, max) of the working volume, world; found from the silhouettes if not given (m)",
        json_schema_extra={"flag": "volume"},
    )
    margin: float = Field(
        default=0.05, ge=0, le=1, description="added on each side of a found volume (fraction of its side)"
    )
    max_cut: float = Field(
        default=0.02, ge=0, le=1, description="fraction of the surface voxels that may lie on the volume's border (0–1)"
    )
    hull: HullSettings = HullSettings()
    colors: Literal["visible", "none"] = Field(
        default="visible", description="colour voxels from the cameras that see them, or leave them grey"
    )
    consistency: ConsistencySettings = ConsistencySettings()
