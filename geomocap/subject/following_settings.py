"""Settings of following a subject's model."""

from __future__ import annotations

from pydantic import Field

from geomocap.settings import Settings


class FollowingSettings(Settings):
    """How the model of a subject is followed through another sequence."""

    points: int = Field(
        default=1200, ge=100, le=1000000, description="points of the model, and of each frame, that are matched"
    )
    start_frames: int = Field(
        default=4,
        ge=1,
        le=1000,
        description="frames in which the model is looked for",
    )
    steps: int = Field(default=8, ge=1, le=1000, description="times that points are matched anew in each frame")
    rounds: int = Field(default=5, ge=0, le=1000, description="rounds in which all frames are fitted together")
    normal: float = Field(default=0.03, ge=0, description="weight of normals in matching (diagonals)")
    color: float = Field(default=0.03, ge=0, description="weight of colours in matching (diagonals)")
    reach: float = Field(default=0.1, gt=0, description="points farther apart don't match (diagonals)")
    along: float = Field(default=0.05, ge=0, description="weight of distances along the surface, against across it")
    independence: float = Field(
        default=0.05, gt=0, le=1, description="fraction of the surface points that err independently (0..1)"
    )
    path_independence: float = Field(
        default=0.3,
        gt=0,
        le=1,
        description="fraction of the tracked patches' observations that err independently (0..1)",
    )
    turn_deg: float = Field(
        default=15.0, gt=0, description="how far joints may leave the pose expected in the next frame (degrees)"
    )
    least_turn_deg: float = Field(
        default=0.5, gt=0, description="least scale of the turning accelerations (degrees/frame²)"
    )
    least_shift: float = Field(default=1e-3, gt=0, description="least scale of the root's (diagonals/frame²)")
    poor_fit: float = Field(
        default=0.025,
        gt=0,
        description="distances between model and sequence above this call for a warning (diagonals)",
    )
