"""From any sequence of meshes, point clouds, voxel grids or arrays to its rigid bodies and joints.

python examples/scans_to_bodies.py SCANS --fps 30 --labels labels.npz
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import geomocap
from geomocap.files.scan_checks import scan_doubts
from geomocap.files.scan_tracks import scan_tracks


def scans_to_bodies(
    folder: Path, fps: float, scale: float = 1.0
) -> tuple[geomocap.Motion, list[np.ndarray], tuple[str, ...]]:
    """Return the motion, the body of each point of each scan, T arrays (N,) int, and what is doubtful."""
    scans = geomocap.open_scans(folder, geomocap.ScanSettings(scale=scale))
    points = [scans.points(frame) for frame in range(len(scans))]
    doubts = scan_doubts(points.__getitem__, scans.names)  # of unit and shape
    tracks = scan_tracks(scans)  # None unless the scans have their points in common
    motion = geomocap.find_motion(points if tracks is None else tracks, fps=fps)
    labels = [motion.label(frame, points[frame]) for frame in range(len(scans))]
    return motion, labels, (*doubts, *motion.warnings)


def main() -> None:
    """Read the command line and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scans", type=Path)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--scale", type=float, default=1.0, help="metres per unit of the scans")
    parser.add_argument("--labels", type=Path, help="file for the bodies of all points, NPZ")
    arguments = parser.parse_args()
    motion, labels, warnings = scans_to_bodies(arguments.scans, arguments.fps, arguments.scale)
    print(f"{motion.body_count} bodies in {len(labels)} scans")
    skeleton = motion.skeleton
    for name, ends, hinge in zip(skeleton.joint_names, skeleton.joint_bodies, motion.joint_is_hinge, strict=True):
        print(f"{name}: {'hinge' if hinge else 'ball'} between bodies {ends[0]} and {ends[1]}")
    for warning in warnings:
        print(f"warning: {warning}")
    if arguments.labels is not None:
        np.savez_compressed(arguments.labels, **{f"frame_{k:06d}": body for k, body in enumerate(labels)})


if __name__ == "__main__":
    main()
