"""Key-points in a TOML file: regions with a name, and links between them for plots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tomli_w
from pydantic import AfterValidator, Field, model_validator

from geomocap.errors import GeometryError, SettingsError
from geomocap.files.atomic import write_text
from geomocap.keypoints.keypoint_following import REACH, Measured, follow_keypoints
from geomocap.model.keypoint_paths import KeyPointPaths, KeyPoints
from geomocap.model.trajectories import TracksByFrame, Trajectories
from geomocap.reading import read_toml
from geomocap.settings import Settings, check_settings
from geomocap.trajectories.smoothing import smooth_motion

_DECIMALS = 6  # of centres and radii in files: micrometres


def _one_line(name: str) -> str:
    """Motion files hold names in one line of fields."""
    if name != name.strip() or not name.isprintable():
        raise ValueError("a name has no spaces around it and no tabs or line breaks")
    return name


Name = Annotated[str, Field(min_length=1, max_length=60), AfterValidator(_one_line)]


class KeyPoint(Settings):
    """A region on the subject."""

    name: Name = Field(description="name, unique")
    center: tuple[float, float, float] = Field(description="centre in the frame `frame` (m, world)")
    radius: float = Field(default=0.03, gt=0, description="radius of the region (m)")
    frame: int = Field(default=0, ge=0, description="frame in which it was placed")


class KeyPointFile(Settings):
    """What `keypoints.toml` holds: a table `[[keypoint]]` for each, and which of them plots join by a line."""

    links: tuple[tuple[Name, Name], ...] = Field(
        default=(), description='pairs of names that plots join by a line: [["hand", "elbow"], …]'
    )
    keypoint: tuple[KeyPoint, ...] = Field(default=(), description="the key-points")

    @model_validator(mode="after")
    def _check_names(self) -> KeyPointFile:
        names = self.names
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"the name {twice[0]} stands twice; names must be unique")
        for link in self.links:
            for name in link:
                if name not in names:
                    known = ", ".join(names) or "none"
                    raise ValueError(f"links name {name}, but no key-point is called so; there are: {known}")
            if link[0] == link[1]:
                raise ValueError(f"links join {link[0]} with itself")
        return self

    @property
    def names(self) -> list[str]:
        """Names of the key-points, in order."""
        return [p.name for p in self.keypoint]


def read_keypoints(path: Path) -> KeyPointFile:
    """Read key-points from a TOML file.

    Raises
    ------
    SettingsError
        If it can't be read, a key is unknown, a name stands twice, or links name a key-point that isn't there.
    """
    values = read_toml(path, SettingsError, "give key-points as [[keypoint]] tables, or place them with --edit")
    return check_settings(KeyPointFile, values, str(path))


def write_keypoints(path: Path, file: KeyPointFile) -> None:
    """Write key-points as TOML, whole or not at all, so that `read_keypoints` returns them again.

    Raises
    ------
    RunError
        If it can't be written.
    """
    values = {
        "links": [list(link) for link in file.links],
        "keypoint": [
            {
                "name": p.name,
                "center": [round(c, _DECIMALS) for c in p.center],
                "radius": max(round(p.radius, _DECIMALS), 10**-_DECIMALS),
                "frame": p.frame,
            }
            for p in file.keypoint
        ],
    }
    write_text(path, tomli_w.dumps(values))


def follow_regions(measured: Measured, points: tuple[KeyPoint, ...]) -> KeyPointPaths:
    """Follow key-points, each from the frame that it was placed in.

    Raises
    ------
    GeometryError
        If there is no such frame.
    """
    T, K = measured.n_frames, len(points)
    paths = KeyPointPaths(
        np.full((T, K, 3), np.nan), np.zeros((T, K), bool), np.zeros((T, K), int), np.full((T, K), np.nan)
    )
    for frame in sorted({p.frame for p in points}):
        here = [k for k, p in enumerate(points) if p.frame == frame]
        centers, radii = np.array([points[k].center for k in here]), np.array([points[k].radius for k in here])
        found = follow_keypoints(measured, centers, radii, frame)
        paths.positions[:, here], paths.bridged[:, here] = found.positions, found.bridged
        paths.n_tracks[:, here], paths.std[:, here] = found.n_tracks, found.std
    return paths


def follow_placed(tracks: Trajectories | TracksByFrame, file: KeyPointFile, fps: float) -> KeyPoints:
    """Follow key-points through trajectories, with velocities.

    Parameters
    ----------
    tracks : Trajectories or TracksByFrame
    file : KeyPointFile
    fps : float
        Frames per second.

    Raises
    ------
    GeometryError
        If there are no key-points, or one is placed in a frame that isn't there or where no trajectories are.
    """
    if not file.keypoint:
        raise GeometryError("no key-points are given; add [[keypoint]] tables, or place them with --edit")
    last = tracks.n_frames - 1
    for p in file.keypoint:
        if p.frame > last:
            raise GeometryError(f"key-point {p.name}: placed in frame {p.frame}, but there are frames 0 to {last}")
    paths = follow_regions(Measured.of(tracks), file.keypoint)
    for k, p in enumerate(file.keypoint):
        if paths.n_tracks[p.frame, k] == 0:
            raise GeometryError(
                f"key-point {p.name}: no trajectory within {1000 * REACH * p.radius:.0f} mm ({REACH:g} radii) of its "
                f"centre in frame {p.frame}; move it onto the surface, enlarge it, or place it in a frame where "
                "trajectories run there"
            )
    motion = smooth_motion(paths.positions.transpose(1, 0, 2), fps)
    names = file.names
    return KeyPoints(
        tuple(names),
        np.array([p.radius for p in file.keypoint]),
        paths,
        np.array([[names.index(n) for n in link] for link in file.links], int).reshape(-1, 2),
        motion.velocities.transpose(1, 0, 2),
        motion.accelerations.transpose(1, 0, 2),
        fps,
    )
