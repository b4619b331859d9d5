"""What a capture, a run, a calibration, a truth, a motion file or scans hold, and what is wrong with them."""

from geomocap.inspection.describe import describe
from geomocap.inspection.description import Description

__all__ = ["Description", "describe"]
