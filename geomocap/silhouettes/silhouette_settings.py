"""Settings of the silhouette stage."""

from __future__ import annotations

from pydantic import Field

from geomocap.settings import Settings


class SilhouetteSettings(Settings):
    """How silhouettes are cut out. Evidence is in units of the log likelihood ratio subject : background."""

    samples: int = Field(
        30,
        ge=2,
        description="Frames, spread over the recording, from which a camera's background is learnt.",
        json_schema_extra={"flag": "background-samples"},
    )
    repair: bool = Field(
        default=True,
        description="Fill enclosed holes behind which the other cameras (4 or more, calibrated) find it thick.",
    )
    gain: bool = Field(
        default=True, description="Follow slow light changes by a gain and an offset per frame and channel."
    )
    threshold: float = Field(
        default=4.0,
        gt=0,
        description="Difference from the background at which a pixel is as likely subject (noise sigmas).",
        json_schema_extra={"flag": "threshold"},
    )
    shadows: bool = Field(
        default=True,
        description="Take darker background with the same colour and texture for shadow.",
        json_schema_extra={"flag": "shadows"},
    )
    colors: bool = Field(
        default=True, description="Judge doubtful pixels by the colours that the subject has elsewhere."
    )
    shadow_darkest: float = Field(
        default=0.5, gt=0, lt=1, description="Brightness left in the deepest shadow (ratio to the background)."
    )
    shadow_lightest: float = Field(
        default=1.1, gt=1, lt=2, description="Brightness of the strongest reflection on the background (ratio)."
    )
    shadow_radius: int = Field(
        default=2, ge=1, le=8, description="Half width of the window that compares texture (pixels)."
    )
    shadow_color: float = Field(
        default=0.03,
        gt=0,
        lt=1,
        description="How much a shadow may change colour, and brightness within the window (ratio).",
    )
    smoothing: float = Field(
        default=3.0, ge=0, description="Reach of the edge-preserving smoothing of the evidence (pixels); 0: none."
    )
    edge: float = Field(default=12.0, gt=0, description="Colour step that stops the smoothing (noise sigmas).")
    unknown: float = Field(
        default=1.0,
        ge=-10,
        le=10,
        description="Evidence for the subject where the background was never seen (log ratio).",
    )
    coherence: float = Field(
        default=3.0,
        ge=0,
        description="Holes and separate pieces with less evidence than this on each pixel of their border are undone.",
    )
    outline_contrast: float = Field(
        default=1.0,
        ge=0,
        description="Contrast to the background that sharpens outlines (standard deviations of the subject's colours).",
    )
    smallest: float = Field(
        default=0.0005, ge=0, lt=1, description="Smaller separate pieces are dropped (fraction of the image)."
    )
    smallest_relative: float = Field(
        default=0.02, ge=0, lt=1, description="Smaller separate pieces are dropped (fraction of the largest piece)."
    )
    support: float = Field(
        default=0.25,
        gt=0,
        le=1,
        description="Fraction of the frames that must agree on a background estimated over time.",
    )
