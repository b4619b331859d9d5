"""From a capture to bodies, joints and motion files.

python examples/capture_to_skeleton.py CAPTURE RUN
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import geomocap
from geomocap import pipeline
from geomocap.config import Config, load_config
from geomocap.files.results import read_skeleton
from geomocap.files.run import Run
from geomocap.model.skeleton import Skeleton
from geomocap.scheduling import threads


def capture_to_skeleton(capture_folder: Path, run_folder: Path, config: Config) -> Skeleton:
    """Take a capture to motion files, and return its skeleton."""
    capture, run = geomocap.open_capture(capture_folder), Run(run_folder)
    with threads() as executor:
        job = pipeline.Job(run, config, executor, capture=capture, fps=capture.fps)
        pipeline.motion_files(job, "voxels")  # silhouettes, voxels, tracks, bodies and skeleton come first
    return read_skeleton(run)


def main() -> None:
    """Read the command line and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--config", type=Path, help="settings, a TOML file")
    arguments = parser.parse_args()
    skeleton = capture_to_skeleton(arguments.capture, arguments.run, load_config(arguments.config))
    print(f"{skeleton.body_rotations.shape[1]} bodies")
    for name, path in zip(skeleton.joint_names, skeleton.joint_positions.swapaxes(0, 1), strict=True):
        travelled = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        print(f"{name}: travelled {travelled:.2f} m")
    print(f"motion files: {arguments.run}")


if __name__ == "__main__":
    main()
