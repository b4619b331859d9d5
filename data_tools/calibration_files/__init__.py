"""Calibrations of other tools: one module a format, with `read_<format>(path) -> Rig` and mostly `write_<format>`."""

from data_tools.calibration_files.aniposelib import read_aniposelib, write_aniposelib, write_caliscope
from data_tools.calibration_files.colmap import read_colmap, write_colmap
from data_tools.calibration_files.detect import detect_format, read_calibration
from data_tools.calibration_files.opencv_yaml import read_easymocap, read_opencv, write_easymocap, write_opencv
from data_tools.calibration_files.pose2sim import read_pose2sim, write_pose2sim
from data_tools.calibration_files.qualisys import read_qualisys

__all__ = [
    "detect_format",
    "read_aniposelib",
    "read_calibration",
    "read_colmap",
    "read_easymocap",
    "read_opencv",
    "read_pose2sim",
    "read_qualisys",
    "write_aniposelib",
    "write_caliscope",
    "write_colmap",
    "write_easymocap",
    "write_opencv",
    "write_pose2sim",
]
