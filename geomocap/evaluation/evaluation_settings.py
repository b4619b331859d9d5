"""Settings of the evaluation."""

from __future__ import annotations

from pydantic import Field

from geomocap.settings import Settings


class EvaluationSettings(Settings):
    """How a run is compared with the truth."""

    every: int = Field(5, ge=1, description="geometry is judged on every n-th frame")
    align: bool = Field(False, description="another system's truth: find the rigid motion between the two worlds")
    find_offset: bool = Field(False, description="another system's truth: find the time offset between the two clocks")
    offset: float = Field(
        0.0, description="another system's truth: its clock minus the run's, where it isn't found (s)"
    )
    max_offset: float = Field(3.0, gt=0, description="largest time offset that is looked for (s)")
    match_within: float = Field(
        0.15,
        gt=0,
        description="mean distance up to which a joint and a marker match (fraction of the subject's diagonal)",
    )
