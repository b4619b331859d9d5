"""Settings of joints found between bodies, and of the refinement of their motion."""

from __future__ import annotations

from pydantic import Field

from geomocap.bodies.body_settings import FOLLOWED
from geomocap.settings import Settings


class MotionSkeletonSettings(Settings):
    """How joints are found between bodies, and how these are connected."""

    interface_prior: float = Field(
        default=0.005,
        gt=0,
        description="least weight of the place where bodies touch (frames in which they turn by a radian)",
    )
    interface_weight: float = Field(
        default=0.05, ge=0, description="tree: weight of a joint's distance from where its bodies touch (no unit)"
    )
    gap_weight: float = Field(default=0.05, ge=0, description="tree: weight of the bodies' distance (no unit)")
    contact_weight: float = Field(
        default=0.01, ge=0, description="tree: cost of bodies without common border (diagonals)"
    )
    largest_gap: float = Field(
        default=0.1,
        gt=0,
        description="bodies farther apart are connected, with a warning, only where some body can't be reached "
        "otherwise: motion files take one tree (diagonals)",
    )


class RefinementSettings(Settings):
    """How the motion of connected bodies is refined over all frames."""

    # 22 sets of paths of 13 captures, 1 and 2 rounds: joints 2.20 and 2.13 % of the height off, rotations 5.6 and 5.7°,
    # all else alike (3 rounds, which then fitted skin weights too: 2.12 %, 5.8°). One round leaves a joint too tight
    # where the body between two others wasn't found.
    rounds: int = Field(
        default=2,
        ge=0,
        le=1000,
        description="rounds of shape, and motion with joints; 0: no refinement",
        json_schema_extra={"flag": "refinement"},
    )
    # With 6e5b991 models of thirteen hard captures overlapped silhouettes by 0.917 without, 0.928 with 3, 0.929 with 5;
    # rotations were 9.2, 9.1 and 9.3° off on average, joints 2.9 and 2.7 % of the height (0 and 3, ten captures). A
    # person on a treadmill, four real cameras: 0.82, 0.85 and 0.85, eleven joints 73, 66 and 63 mm from the markers.
    outline_rounds: int = Field(
        default=3,
        ge=0,
        le=1000,
        description="of captures: rounds in which, then, the surface is to end in the images where silhouettes do; "
        "0: none",
    )
    steps: int = Field(default=4, ge=1, le=1000, description="steps of each adjustment of motion and joints")
    independence: float = Field(
        default=0.3, gt=0, le=1, description="fraction of the observations that err independently of each other (0..1)"
    )
    noise: float = Field(
        default=FOLLOWED, gt=0, description="least standard deviation of how a sample follows its bodies (diagonals)"
    )
    joint_sigma: float = Field(
        default=2e-3,
        gt=0,
        description="standard deviation of the joints found before, against all observations (diagonals)",
    )
    least_slip: float = Field(
        default=3e-4, gt=0, description="least standard deviation of how far a joint's bodies part (diagonals)"
    )
    least_turn_deg: float = Field(
        default=0.3, gt=0, description="least scale of the turning accelerations (degrees/frame²)"
    )
    least_shift: float = Field(
        default=5e-4, gt=0, description="least scale of the root's accelerations (diagonals/frame²)"
    )
    cutoff: float = Field(
        default=3.0, gt=0, description="residuals and accelerations beyond count less (standard deviations)"
    )
