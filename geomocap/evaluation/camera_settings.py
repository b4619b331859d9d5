"""Settings of the check of the cameras."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class CameraSettings(Settings):
    """What becomes of cameras that don't fit the others."""

    that_disagree: Literal["warn", "drop", "stop"] = Field(
        default="warn",
        description="Cameras whose silhouettes contradict the others' are named only, left out, or end the run.",
        json_schema_extra={"flag": "cameras-that-disagree"},
    )
