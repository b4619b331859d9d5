"""Calibrations of other tools: one module a format, each with `read_<format>(path) -> Rig`."""

from data_tools.calibration_files.pose2sim import read_pose2sim, write_pose2sim
from data_tools.calibration_files.qualisys import read_qualisys

__all__ = ["read_pose2sim", "read_qualisys", "write_pose2sim"]
