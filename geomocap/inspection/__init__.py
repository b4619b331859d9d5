"""What a capture, a run, a calibration, a truth or a motion file holds, and what is wrong with it."""

from geomocap.inspection.describe import describe
from geomocap.inspection.description import Description

__all__ = ["Description", "describe"]
