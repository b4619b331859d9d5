"""Settings of the segmentation and of the skeleton that is built on it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class SegmentationSettings(Settings):
    """How points are divided into ellipsoids and these into rigid bodies."""

    method: Literal["motion", "m3"] = Field(
        default="motion",
        description="motion: bodies from how the tracked surface turns; m3: the paper's split, merge, match and paths",
        json_schema_extra={
            "flag": "method",
            "evidence": "adjusted Rand index of all points / of the bodies' cores, synthetic man and horse walking, "
            "version 0.1: motion 0.92 / 0.99 and 0.67 / 0.81, m3 0.21 / 0.34 and 0.11 / 0.13, carried by patches "
            "0.73 / 0.88 and 0.44 / 0.55",
        },
    )
    paths: Literal["auto", "patches", "nodes", "both", "points", "ellipsoids"] = Field(
        default="auto",
        description="what follows the surface: patches of the images; nodes on the geometry alone (the images are then "
        "not tracked at all); both: nodes that patches keep from sliding; points: those of scans which are the same in "
        "all frames; ellipsoids: the paper's, split, merged and matched, for comparison; auto: of a capture patches "
        "where they cover the surface, and on the rest of it nodes that they hold; of scans points where neighbours "
        "stay so, otherwise nodes; with m3 patches or points carry the paper's ellipsoids, else nothing does",
        json_schema_extra={
            "flag": "paths",
            "evidence": "as above, but without soft borders and refinement: patches 0.81 / 0.97 and 0.64 / 0.75, nodes "
            "0.67 / 0.85 and 0.48 / 0.59, ellipsoids 0.37 / 0.49 and 0.25 / 0.34",
        },
    )
    max_depth: int = Field(
        default=7, ge=1, le=10, description="levels of splitting; at most 2^levels ellipsoids a frame"
    )
    min_points: int = Field(
        default=16, ge=4, description="least points of an ellipsoid; smaller sets are not split further"
    )
    split_error: float = Field(
        default=0.2,
        gt=0,
        description="fitting error above which an ellipsoid is split (equivalent length, point spacings)",
    )
    merge_error: float = Field(
        default=2.0,
        ge=0,
        description="fitting error below which neighbours of the first frame are merged (equivalent length, spacings)",
    )
    size_weight: float = Field(
        default=0.5, ge=0, description="matching: weight of a size difference against a distance of centres (no unit)"
    )
    coherence_weight: float = Field(
        default=0.0,
        ge=0,
        description="matching: weight of neighbours that move differently against a distance of centres (no unit)",
    )
    iterative: bool = Field(
        default=False, description="take the largest body out and repeat on each isolated rest, for noisy volumes"
    )
