"""Settings of the motion files."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class ExportSettings(Settings):
    """What motion files hold, and in which units."""

    joints: Literal["auto", "fixed", "moving"] = Field(
        "auto",
        description="fixed: constant offsets between joints; moving: every joint shifts in every frame; auto: only "
        "those joints shift that no constant offset reproduces within 0.01 mm",
    )
    bvh_unit: Literal["m", "cm"] = Field("m", description="unit of BVH files, which can't say it themselves")
    trc_unit: Literal["mm", "m"] = Field("mm", description="unit of TRC files, stated in their header")
    ellipsoids: bool = Field(True, description="whether the ellipsoids' centres are markers, too")
    surface: Literal["auto", "bones", "skin"] = Field(
        "auto",
        description="what GLB and USD show: a bone for each body, or the subject's own surface; auto: the surface "
        "where the run has the subject's model",
    )
    skin_frame: int = Field(
        0, ge=0, description="reference frame whose surface is taken; a subject's model is used for frame 0"
    )
    skin_colors: Literal["body", "true"] = Field(
        "body", description="colour the surface by body, or by its own colours"
    )
    skin_triangles: int = Field(50000, ge=500, description="triangles of the surface at most")
    skin_blend: float = Field(
        0.02,
        gt=0,
        le=0.5,
        description="width over which bodies blend at their borders (fraction of the subject's diagonal)",
    )
