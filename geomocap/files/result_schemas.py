"""The arrays of a run's results, file by file: what reading them checks."""

from __future__ import annotations

import numpy as np

from geomocap.files.array_schema import FPS, Expected
from geomocap.model.skeleton import Skeleton

_PLACES, _SPEEDS = Expected("N T 3", gaps=True), Expected("N T", gaps=True)

ELLIPSOIDS_SCHEMA = {
    "centers": Expected("T K 3"),
    "radii": Expected("T K 3", low=0),
    "rotations": Expected("T K 3 3", "rotation"),
    "counts": Expected("T K", "whole", low=0),
    "errors": Expected("T K", gaps=True),
    "body": Expected("K", "whole", low=-1),
}

SKELETON_SCHEMA = {
    "body_rotations": Expected("T B 3 3", "rotation", gaps=True),
    "body_positions": Expected("T B 3", gaps=True),
    "joint_bodies": Expected("J 2", "whole"),
    "joint_positions": Expected("T J 3", gaps=True),
    "joint_names": Expected("J", "text"),
    "body_names": Expected("B", "text"),
    "offsets": Expected("J 3", gaps=True),
    "body_offsets": Expected("B 3", gaps=True),
    "fps": FPS,
}

KEYPOINTS_SCHEMA = {
    "names": Expected("K", "text"),
    "positions": Expected("T K 3", gaps=True),
    "radius": Expected("K", low=0),
    "bridged": Expected("T K", "truth"),
    "tracks": Expected("T K", "whole", low=0),
    "std": Expected("T K", gaps=True),
    "velocities": Expected("T K 3", gaps=True),
    "accelerations": Expected("T K 3", gaps=True),
    "links": Expected("L 2", "whole"),
    "fps": FPS,
}

TRACKS_SCHEMA = {
    "positions": _PLACES,
    "sigma": _SPEEDS,
    "correlation": _SPEEDS,
    "n_views": Expected("N T", "whole", low=0),
    "ray": Expected("N T 3", gaps=True),
    "normals": Expected("N 3", gaps=True),
    "placed": Expected("N", "whole", low=0, high="T"),
    "velocities": _PLACES,
    "accelerations": _PLACES,
    "velocity_std": _SPEEDS,
    "acceleration_std": _SPEEDS,
    "kept": Expected("N", "whole", low=0),
}

DIAGNOSTICS_SCHEMA = {
    "sample_positions": _PLACES,
    "sample_body": Expected("N", "whole", low=-1),
    "sample_residuals": Expected("N", gaps=True),
    "body_confidence": Expected("B", gaps=True),
    "joint_axes": Expected("J 3", gaps=True),
    "joint_std": Expected("J 3", gaps=True),
}


def skeleton_gaps(skeleton: Skeleton) -> list[str]:
    """Say of what a skeleton's motion is not known, which files fill in."""
    said = []
    for name, values in (
        ("body_rotations", skeleton.body_rotations),
        ("body_positions", skeleton.body_positions),
        ("joint_positions", skeleton.joint_positions),
    ):
        lacking = ~np.isfinite(values).reshape(skeleton.frame_count, -1).all(axis=1)
        if lacking.any():
            said.append(
                f"skeleton.npz: {name} has gaps (NaN) in {int(lacking.sum())} of {len(lacking)} frames; "
                "files fill them evenly"
            )
    return said
