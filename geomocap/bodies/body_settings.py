"""Settings of the bodies found from motion paths."""

from __future__ import annotations

import math

from pydantic import Field

from geomocap.settings import Settings

FOLLOWED = 2e-4  # diagonals; no surface is followed more exactly, whatever is stated


class MotionBodiesSettings(Settings):
    """How rigid bodies are found from motion paths."""

    bodies: int = Field(
        default=0,
        ge=0,
        le=100,
        description="number of bodies; 0: found automatically",
        json_schema_extra={"flag": "bodies"},
    )
    min_turn_deg: float = Field(
        default=15.0,
        gt=0,
        lt=180,
        description="a body turns at least this much against each neighbour, or slides as far over it (degrees)",
        json_schema_extra={"flag": "min-turn"},
    )
    part_turn_deg: float = Field(
        default=12.0,
        gt=0,
        lt=180,
        description="the same where samples move with rigid parts, whose turns are known better (degrees)",
    )
    radius: float = Field(
        default=0.03,
        gt=0,
        lt=0.5,
        description="surface around a sample that shows how it turns, more where noise asks for it (fraction of the "
        "diagonal)",
    )
    first_cut_deg: float = Field(
        default=9.0, gt=0, lt=180, description="groups of samples that turn less differently are the start (degrees)"
    )
    min_fraction: float = Field(
        default=0.01,
        ge=0,
        lt=0.5,
        description="bodies of fewer samples need as much more evidence (fraction of the samples; what one camera "
        "alone sees counts two thirds)",
        json_schema_extra={"flag": "min-fraction"},
    )
    soft_fraction: float = Field(
        default=0.18,
        ge=0,
        lt=1,
        description="soft skin between two bodies differs from a blend of them by up to this fraction of how far they "
        "turn it apart about their common point (0..1); 0 where samples move with rigid parts",
    )
    neighbours: int = Field(default=10, ge=4, le=1000, description="neighbours of a sample on the surface")
    max_stretch: float = Field(
        default=2.0, gt=1, description="neighbours that separate more are none (times the usual distance)"
    )
    reach: float = Field(
        default=0.08, gt=0, lt=1, description="a sample may belong to bodies this near along the surface (diagonals)"
    )
    depth_rounds: int = Field(
        default=2,
        ge=0,
        le=1000,
        description="times that depths of what single cameras see are found from the bodies, and bodies from these",
    )
    blends: bool = Field(
        default=True,
        description="samples may follow a blend of two bodies, as soft skin does",
        json_schema_extra={"flag": "soft-borders"},
    )
    blend_penalty: float = Field(
        default=0.004, ge=0, description="an even blend of two bodies counts as a residual of this (diagonals)"
    )
    largest_residual: float = Field(default=0.03, gt=0, description="larger residuals count as this (diagonals)")
    smoothness: float = Field(
        default=0.3, ge=0, lt=1, description="weight of its neighbours in the choice of a sample's body (0..1)"
    )

    def least_turn(self, rigid: bool) -> float:
        """Turn of a body against each neighbour, at least, radians; `rigid`: its samples move with rigid parts."""
        return math.radians(self.part_turn_deg if rigid else self.min_turn_deg)
