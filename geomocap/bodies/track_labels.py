"""Bodies of tracks that bodies were not found from: by where they lie, and by how they move."""

from __future__ import annotations

import numpy as np

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.bodies.point_labels import LEAST_VOTES, Voters
from geomocap.model.even_choice import evenly_chosen

_FRAMES = 12  # in which a track is compared with the samples around it
_ROUNDS = 3  # of the robust place at rest
_CHUNK = 2000


def label_tracks(bodies: MotionBodies, samples: Voters, tracks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bodies of tracks of the surface.

    The samples around a track propose bodies. Each is as likely as its votes, and as the track's place in the body
    stays where it is over all frames. What it misses by is Gaussian; its variance is that of the surface's noise and of
    what the best of the bodies misses: where skin is soft, and no body fits well, votes decide.

    Parameters
    ----------
    bodies : MotionBodies
    samples : Voters
        Of these bodies.
    tracks : (N, T, 3) float, metres, world
        NaN where unseen.

    Returns
    -------
    labels : (N,) int32
        −1: seen in no frame.
    rest : (N, 3) float, metres, world
        Where each is in frame 0, carried by its body; NaN without one.
    """
    parts = [_label_some(bodies, samples, tracks[i : i + _CHUNK]) for i in range(0, len(tracks), _CHUNK)]
    if not parts:
        return np.empty(0, np.int32), np.empty((0, 3))
    return np.concatenate([labels for labels, _ in parts]), np.concatenate([rest for _, rest in parts])


def _label_some(bodies: MotionBodies, samples: Voters, tracks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    seen = np.isfinite(tracks).all(axis=2)
    votes = _votes(samples, tracks, seen)
    proposed = votes > LEAST_VOTES
    square = np.full(votes.shape, np.inf)
    places = np.full((*votes.shape, 3), np.nan)
    for b in range(bodies.body_count):
        rows = np.flatnonzero(proposed[:, b])
        square[rows, b], places[rows, b] = _misses(bodies, b, tracks[rows], seen[rows])
    best = square.min(axis=1, initial=np.inf)
    known = np.isfinite(best)
    likely = np.full(votes.shape, -np.inf)
    likely[proposed] = np.log(votes[proposed])
    scale = 2.0 * (np.where(known, best, 0.0) + bodies.noise**2)[:, None]
    likely -= np.where(proposed, square - np.where(known, best, 0.0)[:, None], 0.0) / scale
    labels = np.where(known, likely.argmax(axis=1), -1).astype(np.int32)
    rest = places[np.arange(len(labels)), np.maximum(labels, 0)]
    return labels, np.where(known[:, None], rest, np.nan)


def _votes(samples: Voters, tracks: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Votes of the samples around each track for its body, (N, B): mean over frames; 0 where it is seen in none."""
    votes, count = np.zeros((len(tracks), samples.weights.shape[1])), np.zeros(len(tracks))
    looked_at = evenly_chosen(tracks.shape[1], _FRAMES)
    for frame in (*looked_at, *np.setdiff1d(np.arange(tracks.shape[1]), looked_at)):
        some = np.flatnonzero(seen[:, frame] & ((count == 0) | np.isin(frame, looked_at)))
        if len(some):
            votes[some] += samples.votes(int(frame), tracks[some, frame])
            count[some] += 1
    return votes / np.maximum(count, 1)[:, None]


def _misses(bodies: MotionBodies, body: int, tracks: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares (N,), metres², by which tracks miss their places in a body, and these in frame 0, (N, 3).

    Places are robust means: frames count less, the more the track misses in them (Cauchy).
    """
    moved = np.where(seen[..., None], tracks, 0.0) - bodies.translations[:, body]
    back = np.einsum("tji,ntj->nti", bodies.rotations[:, body], moved)
    weight, count = seen.astype(float), np.maximum(seen.sum(axis=1), 1)
    for _ in range(_ROUNDS):
        total = np.maximum(weight.sum(axis=1), 1e-12)
        place = np.einsum("nt,nti->ni", weight, back) / total[:, None]
        miss = ((back - place[:, None]) ** 2).sum(axis=2) * seen
        typical = np.maximum(miss.sum(axis=1) / count, 1e-18)
        weight = seen / (1.0 + miss / (4.0 * typical[:, None]))
    return miss.sum(axis=1) / np.maximum(count - 1, 1), place
