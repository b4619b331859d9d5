"""Cameras, lenses and poses from a bar with two balls that is moved through the volume.

python examples/calibrate_by_bar.py CAPTURE
"""

from __future__ import annotations

import argparse
from pathlib import Path

from geomocap.calibration.bar_calibration import Calibration
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.from_capture import calibrate_capture
from geomocap.calibration.world import WorldKnowledge
from geomocap.scheduling import threads


def calibrate_by_bar(capture: Path, floor: tuple[int, ...] = ()) -> Calibration:
    """Calibrate from CAPTURE/bar; `floor` names frames in which the bar lies on the floor."""
    with threads() as executor:
        return calibrate_capture(capture, BarSettings(), WorldKnowledge(floor=floor), executor=executor)


def main() -> None:
    """Read the command line, calibrate, write CAPTURE/sparse and say how good it is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--floor", type=int, nargs="*", default=(), metavar="FRAME")
    arguments = parser.parse_args()
    result = calibrate_by_bar(arguments.capture, tuple(arguments.floor))
    result.write(arguments.capture / "sparse")
    print(result.verdict.summary)
    for warning in result.verdict.warnings:
        print(f"warning: {warning}")
    print(f"bar ends are known to {1000 * result.covariance.point_sigma:.2f} mm")
    for name, center in zip(result.rig.names, result.rig.centers, strict=True):
        print(f"camera {name} at {center.round(3)} m")


if __name__ == "__main__":
    main()
