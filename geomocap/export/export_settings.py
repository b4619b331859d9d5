"""Settings of the motion files."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class ExportSettings(Settings):
    """What motion files hold, and in which units."""

    names: str = Field(
        "auto",
        description="names of bodies and joints: auto (from the template that fits clearly, else numbers), none, a "
        "template (human, quadruped, bird, hand, or a TOML file), or a file of your own names; RUN/names.toml goes "
        "before found ones",
        json_schema_extra={"flag": "names"},
    )
    name_set: Literal["plain", "opensim", "mixamo", "humanik", "coco"] = Field(
        "plain", description="whose words names are in", json_schema_extra={"flag": "name-set"}
    )
    rest_pose: Literal["first", "T", "A"] = Field(
        "first",
        description="pose of a skeleton whose joints are not turned, in BVH, GLB and USD: the first frame, or a person "
        "standing with arms to the sides (T) or half down (A), for retargeting",
        json_schema_extra={"flag": "rest-pose"},
    )
    zero_frame: int | None = Field(
        None,
        ge=0,
        description="frame in which all joint angles are zero; by default straight limbs have none",
    )
    density: float = Field(
        1000.0, gt=0, description="density that gives OpenSim's and URDF's bodies their mass (kg/m³)"
    )
    joints: Literal["auto", "fixed", "moving"] = Field(
        "auto",
        description="fixed: constant offsets between joints; moving: every joint shifts in every frame; auto: only "
        "those joints shift that no constant offset reproduces within 0.01 mm",
        json_schema_extra={"flag": "joints"},
    )
    bvh_unit: Literal["m", "cm"] = Field(
        "m", description="unit of BVH files, which can't say it themselves", json_schema_extra={"flag": "bvh-unit"}
    )
    trc_unit: Literal["mm", "m"] = Field(
        "mm", description="unit of TRC files, stated in their header", json_schema_extra={"flag": "trc-unit"}
    )
    ellipsoids: bool = Field(
        True, description="whether the ellipsoids' centres are markers, too", json_schema_extra={"flag": "ellipsoids"}
    )
    surface: Literal["auto", "bones", "skin"] = Field(
        "auto",
        description="what GLB and USD show: a bone for each body, or the subject's own surface; auto: the surface "
        "where the run has the subject's model",
        json_schema_extra={"flag": "surface"},
    )
    skin_frame: int = Field(
        0,
        ge=0,
        description="reference whose surface is taken (frame); a subject's model is used for frame 0",
        json_schema_extra={"flag": "skin-frame"},
    )
    skin_colors: Literal["body", "true"] = Field(
        "body",
        description="colour the surface by body, or by its own colours",
        json_schema_extra={"flag": "skin-colors"},
    )
    skin_triangles: int = Field(
        50000, ge=500, description="triangles of the surface at most", json_schema_extra={"flag": "skin-triangles"}
    )
    skin_blend: float = Field(
        0.02,
        gt=0,
        le=0.5,
        description="width over which bodies blend at their borders (fraction of the subject's diagonal)",
    )
