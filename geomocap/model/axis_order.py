"""Which axis of tracks is time: told by what is near in one frame, and on one body stays so in all."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.even_choice import evenly_chosen

_MOST = 24  # points and frames looked at: few, so that noise is small against the distance of neighbours
_LEAST = 6  # points and frames; fewer tell nothing
_NEIGHBOURS = 3
_STAYS = 2.0  # times as far or as near at most
# Fraction of neighbours that stay in the other order, and how many more than in the given one. With swapped axes 0.3 to
# 0.8 more did in 30 made-up and tracked captures. In the right order none did, and at most 0.19 of things that are
# carried along, with noise of a sixth of their thickness.
_MOSTLY, _MORE = 0.85, 0.25


def seem_swapped(tracks: np.ndarray) -> bool:
    """Whether the first two axes of tracks (N, T, 3), metres, NaN where unseen, seem to have changed places.

    Points that are neighbours keep their distance, but for a few at joints. Frames that are neighbours on the path of
    one point are nearer each other, or farther, on that of another one, which moves less, or more. Of subjects that
    mostly move as a whole, both orders look alike, and nothing is said.
    """
    some = tracks[evenly_chosen(tracks.shape[0], _MOST)][:, evenly_chosen(tracks.shape[1], _MOST)]
    given, exchanged = _that_stay(some), _that_stay(some.swapaxes(0, 1))
    return bool(exchanged > _MOSTLY and exchanged - given > _MORE)


def _that_stay(tracks: np.ndarray) -> float:
    """Fraction of neighbours that keep their distance in the other frames; NaN if there are too few."""
    seen = np.isfinite(tracks).all(axis=2)
    if min(seen.shape) < _LEAST or not seen.any():
        return np.nan
    known = np.where(seen[..., None], tracks, 0.0)
    middle = known.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]
    spread = (np.where(seen[..., None], known - middle, 0.0) ** 2).sum(axis=(0, 2))
    first = int(spread.argmax())  # where many are seen, far from each other
    points = tracks[seen[:, first]]
    if len(points) < _LEAST:
        return np.nan
    distance, near = (found[:, 1:] for found in cKDTree(points[:, first]).query(points[:, first], _NEIGHBOURS + 1))
    apart = np.linalg.norm(points[near] - points[:, None], axis=3)
    apart = np.delete(apart, first, axis=2)[distance > 0] / distance[distance > 0][:, None]
    apart = apart[np.isfinite(apart)]
    return float(((apart <= _STAYS) & (apart >= 1 / _STAYS)).mean()) if len(apart) else np.nan
