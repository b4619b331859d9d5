"""What the silhouettes of a recording say of its calibration."""

from __future__ import annotations

from dataclasses import dataclass

from geomocap.model.rig import Rig


@dataclass(frozen=True)
class CameraCorrection:
    """A calibration held against outlines.

    Attributes
    ----------
    given, rig : Rig
        The calibration, and the cameras to use: the same if no correction is called for.
    before, after : float, pixels
        Median disagreement about the outlines of the two cameras that disagree most, and what is left of it in frames
        that a correction wasn't found from. NaN if the outlines can't tell, or if there was no need for any.
    """

    given: Rig
    rig: Rig
    before: float
    after: float

    @property
    def is_corrected(self) -> bool:
        """Whether the cameras to use are others than those given."""
        return self.rig is not self.given
