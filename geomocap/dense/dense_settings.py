"""Settings of surface measurement."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.matching.matching_settings import GrowingSettings, KernelSettings, SeedSettings, WallisSettings
from geomocap.settings import Settings


class GroupSettings(Settings):
    """Which cameras are matched with each other."""

    templates: Literal["auto", "one", "all"] = Field(
        "auto",
        description="one: the most central camera; all: every camera; auto: one up to three cameras",
        json_schema_extra={"flag": "templates"},
    )
    template_camera: str | None = Field(
        None, description="the template if there is only one; the most central if not given"
    )
    searches: int = Field(2, ge=1, le=6, description="most search images of a template")
    least_angle: float = Field(6.0, ge=0, lt=90, description="least angle between viewing directions (degrees)")
    best_angle: float = Field(25.0, gt=0, lt=90, description="angle between viewing directions aimed at (degrees)")
    greatest_angle: float = Field(60.0, gt=0, lt=120, description="greatest angle between viewing directions (degrees)")
    near: float = Field(0.5, gt=0, description="least depth where nothing else bounds it (fraction of the scene's)")
    far: float = Field(1.6, gt=0, description="greatest depth, likewise (fraction of the scene's)")


class MergeSettings(Settings):
    """How the clouds of several templates become one."""

    distance: float = Field(
        0.0, ge=0, description="depth within which two clouds show the same surface; 0: from their spacing (m)"
    )
    support: bool = Field(True, description="drop points through which more templates see than agree with them")


class TrustSettings(Settings):
    """When matches are believed: what is beyond these limits comes from a wrong calibration or from chance."""

    residual: float = Field(
        0.8, gt=0, description="greatest median distance from the epipolar lines of matches left free (px)"
    )
    warning: float = Field(0.3, gt=0, description="the same beyond which there is a warning (px)")
    pair_residual: float = Field(0.2, gt=0, description="the same where no third image confirms the matches (px)")
    growth: float = Field(0.1, ge=0, description="least matched area, in areas that the seeds stand for")
    removed: float = Field(
        0.25,
        gt=0,
        le=1,
        description="greatest fraction that disagrees with its neighbours, unconfirmed by a third image",
    )
    confirmed: float = Field(
        0.01, ge=0, le=1, description="fraction seen in several search images that confirms the rest"
    )


class CloudSettings(Settings):
    """Surface measurement: from the images of one frame to a point cloud."""

    wallis: WallisSettings = Field(default_factory=WallisSettings, description="contrast enhancement")
    groups: GroupSettings = Field(default_factory=GroupSettings, description="which cameras are matched")
    seeds: SeedSettings = Field(default_factory=SeedSettings, description="where matching begins")
    growing: GrowingSettings = Field(default_factory=GrowingSettings, description="how it spreads")
    kernel: KernelSettings = Field(default_factory=KernelSettings, description="how one patch is matched")
    trust: TrustSettings = Field(default_factory=TrustSettings, description="when matches are believed")
    merge: MergeSettings = Field(default_factory=MergeSettings, description="how clouds become one")
    bounds: Literal["auto", "hull", "silhouettes", "none"] = Field(
        "auto",
        description="what bounds the search; auto: the most that cameras, masks and backgrounds allow",
        json_schema_extra={"flag": "bounds"},
    )
    spacing: float | None = Field(
        None,
        gt=0,
        description="distance of neighbouring points on the surface, instead of cloud.growing.step (m)",
        json_schema_extra={"flag": "cloud-spacing"},
    )
    least_views: int = Field(2, ge=2, description="cameras that have to see a point, the template included")
    contour_margin: int = Field(1, ge=0, description="pixels along a silhouette's contour that are not used (px)")
    silhouette_margin: int = Field(3, ge=0, description="how far points may project outside other silhouettes (px)")
    hull_depth: float = Field(
        0.1, gt=0, description="how far behind the hull's front the surface is sought (diagonals of the hull)"
    )
    normal_radius: int = Field(1, ge=0, le=5, description="cells around a point whose slopes make its normal")
