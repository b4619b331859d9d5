"""Settings of the silhouette stage."""

from __future__ import annotations

from pydantic import Field

from geomocap.settings import Settings


class SilhouetteSettings(Settings):
    """How silhouettes are cut out."""

    samples: int = Field(
        30,
        ge=2,
        le=10000,
        description="Frames, spread over the recording, from which a camera's background is learnt.",
        json_schema_extra={"flag": "background-samples"},
    )
    joint: bool = Field(
        default=True,
        description="All cameras decide together, if they are calibrated: what no other camera confirms goes, and what "
        "the others see counts where a camera is undecided.",
    )
    correct_cameras: bool = Field(
        default=True,
        description="Where the outlines contradict the calibration by more than they do each other once the cameras' "
        "poses are adjusted, the run uses adjusted cameras.",
    )
    gain: bool = Field(
        default=True, description="Follow slow light changes by a gain and an offset per frame and channel."
    )
    shadows: bool = Field(
        default=True,
        description="Take darker background with the same colour and texture for shadow.",
        json_schema_extra={"flag": "shadows"},
    )
    shadow_darkest: float = Field(
        default=0.5, gt=0, lt=1, description="Brightness left in the deepest shadow (ratio to the background)."
    )
    smallest: float = Field(
        default=0.0005, ge=0, lt=1, description="Smaller separate pieces are dropped (fraction of the image)."
    )
    support: float = Field(
        default=0.25,
        gt=0,
        le=1,
        description="Fraction of the frames that must agree on a background estimated over time.",
    )
