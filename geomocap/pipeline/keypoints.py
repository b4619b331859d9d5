"""Key-points: regions that somebody placed on the surface, followed by the trajectories inside → `keypoints.npz`."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
from pydantic import Field

from geomocap.errors import RunError, SettingsError
from geomocap.run import Run
from geomocap.settings import Settings, check_settings
from geomocap.tracking.keypoints import KeyPointPaths, follow_keypoints
from geomocap.tracking.trajectories import LAST_FRAME, Trajectories


class KeyPoint(Settings):
    """A region on the subject."""

    name: str = Field(min_length=1, description="name, unique")
    center: tuple[float, float, float] = Field(description="centre in the frame `frame` (m, world)")
    radius: float = Field(default=0.03, gt=0, description="radius of the region (m)")
    frame: int = Field(default=0, ge=0, description="frame in which it was placed")


class KeyPointFile(Settings):
    """What `keypoints.toml` holds: a table `[[keypoint]]` for each."""

    keypoint: tuple[KeyPoint, ...] = Field(min_length=1, description="the key-points")


def read_keypoints(path: Path) -> tuple[KeyPoint, ...]:
    """Read key-points from a TOML file.

    Raises
    ------
    SettingsError
        If it can't be read, a key is unknown, or a name stands twice.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(
            f"{path}: can't be read ({error.strerror}); give key-points as [[keypoint]] tables"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not valid TOML ({error})") from None
    points = check_settings(KeyPointFile, values, str(path)).keypoint
    names = [p.name for p in points]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise SettingsError(f"{path}: the name {twice[0]} stands twice; names must be unique")
    return points


def keypoints(run: Run, points: tuple[KeyPoint, ...]) -> KeyPointPaths:
    """Follow key-points through a run's trajectories and write `keypoints.npz`.

    Raises
    ------
    RunError
        If the run has no trajectories.
    """
    if not (run.path / "tracks.npz").exists():
        raise RunError(f"{run.path}: has no tracks.npz; run `geomocap track CAPTURE {run.path}` first")
    tracks = trajectories_of(run.read_npz("tracks.npz"))
    T, K = tracks.n_frames, len(points)
    positions, bridged, count = np.full((T, K, 3), np.nan), np.zeros((T, K), bool), np.zeros((T, K), int)
    for frame in sorted({p.frame for p in points}):
        placed = [k for k, p in enumerate(points) if p.frame == frame]
        centers, radii = np.array([points[k].center for k in placed]), np.array([points[k].radius for k in placed])
        found = follow_keypoints(tracks, centers, radii, frame)
        positions[:, placed], bridged[:, placed], count[:, placed] = found.positions, found.bridged, found.n_tracks
    run.write_npz(
        "keypoints.npz",
        names=np.array([p.name for p in points]),
        positions=positions,
        radius=np.array([p.radius for p in points]),
        bridged=bridged,
        tracks=count,
    )
    return KeyPointPaths(positions, bridged, count)


def trajectories_of(arrays: dict[str, np.ndarray]) -> Trajectories:
    """Make trajectories of the arrays of `tracks.npz`, of which only the positions must be there."""
    positions = arrays["positions"]
    N, T = positions.shape[:2]
    nothing = np.zeros(N, int)
    return Trajectories(
        positions,
        np.full((N, T, 3, 3), np.nan),
        arrays.get("sigma", np.full((N, T), np.nan)),
        arrays.get("correlation", np.full((N, T), np.nan)),
        arrays.get("n_views", np.isfinite(positions[:, :, 0]).astype(int)),
        arrays.get("normals", np.zeros((N, 3))),
        arrays.get("placed", nothing),
        arrays.get("end_reason", np.full(N, LAST_FRAME)),
        arrays.get("begin_reason", np.full(N, LAST_FRAME)),
    )
