"""Depths of patches that one camera alone sees, adjusted to the motion of what is around them.

The volume says only roughly how deep such a patch lies, and that differently in each frame, as the hull changes its
shape with the pose. But surfaces are rigid piece by piece: a patch and its companions, of which other cameras see some,
keep their places among each other. Rotations of the neighbourhoods, their shapes and the depths are found in turn (as
rigid as possible: Sorkine, Alexa 2007; here the shape is unknown as well, and the mean over all frames). Each depth is
held where the volume puts it, with its standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.linalg import spsolve

from geomocap.model.rotations import nearest_rotation
from geomocap.model.trajectories import Trajectories
from geomocap.scheduling import map_items, threads
from geomocap.trajectories.completion import nearest_companions

_COMPANIONS = 12  # of a patch
_ROUNDS = 6  # of turns, depths and shapes
_LOOSE = 1 / 3  # distance at which companions count half, in standard deviations of the depths
_KEEPS = 1 / 6  # standard deviation of the shape that companions keep, in the same
_FRACTION = 2.0  # weight of all companions together
_FAR = 1.5  # depths that differ by more from the volume's lose it, standard deviations


@dataclass(frozen=True)
class _Shape:
    """Neighbourhoods as they are in all frames.

    Attributes
    ----------
    first, second : (E,) int
        Patch and companion.
    offset : (E, 3) float, metres
        From the first to the second, in the first's orientation.
    spread : (E,) float, metres
        Root mean square by which that changes with time.
    """

    first: np.ndarray
    second: np.ndarray
    offset: np.ndarray
    spread: np.ndarray


def adjust_depths(tracks: Trajectories) -> Trajectories:
    """Move positions that a single camera measured along their rays.

    Parameters
    ----------
    tracks : Trajectories

    Returns
    -------
    Trajectories
        Their standard deviations stay: what is wrong with a depth in all frames alike is not seen.
    """
    has, directions = tracks.measured, tracks.ray
    alone = directions.any(axis=2)
    if not alone.any():
        return tracks
    depth_std = float(np.sqrt(3) * np.median(tracks.sigma[alone]))
    near, _ = nearest_companions(tracks.positions, has, _COMPANIONS)
    first, second = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    first, second = first[first != second], second[first != second]
    place = np.nan_to_num(tracks.positions)
    positions = place.copy()
    shape = _first_shape(first, second, positions, np.nan_to_num(tracks.rotations), has)
    for _ in range(_ROUNDS):
        total, square, weight = np.zeros((len(first), 3)), np.zeros(len(first)), np.zeros(len(first))
        count = np.zeros(len(first))
        frame = partial(_adjusted, place, positions, directions, has, shape, depth_std)
        with threads() as executor:
            for t, (edges, shift, w, seen) in enumerate(map_items(frame, range(tracks.n_frames), executor)):
                positions[:, t] += shift
                total[edges] += w[:, None] * seen
                weight[edges] += w
                square[edges] += ((seen - shape.offset[edges]) ** 2).sum(axis=1)
                count[edges] += 1
        offset = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-12)[:, None], shape.offset)
        shape = replace(shape, offset=offset, spread=np.sqrt(square / np.maximum(count, 1)))
    return replace(tracks, positions=np.where(has[:, :, None], positions, np.nan))


def _adjusted(
    place: np.ndarray,
    positions: np.ndarray,
    directions: np.ndarray,
    has: np.ndarray,
    shape: _Shape,
    depth_std: float,
    t: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Adjust the depths of one frame.

    Returns
    -------
    edges : (F,) int
        Neighbours that are both measured.
    shift : (N, 3) float, metres
    weights : (F,) float
    seen : (F, 3) float, metres
        Where the companions lie then, in the neighbourhood's frame.
    """
    edges = np.flatnonzero(has[shape.first, t] & has[shape.second, t])
    if not len(edges):
        return edges, np.zeros_like(place[:, t]), np.zeros(0), np.zeros((0, 3))
    turn = _rotations(positions[:, t], shape, edges, depth_std)
    w, kept = _weights(positions[:, t], turn, shape, edges, depth_std)
    shift = _shift(place[:, t], positions[:, t], directions[:, t], kept, w, shape, edges, depth_std)
    moved = positions[:, t] + shift
    i, j = shape.first[edges], shape.second[edges]
    return edges, shift, w, np.einsum("eji,ej->ei", turn[i], moved[j] - moved[i])


def _first_shape(
    first: np.ndarray, second: np.ndarray, positions: np.ndarray, rotations: np.ndarray, has: np.ndarray
) -> _Shape:
    """Shape as the measured turns of the patches show it."""
    total, square, count = np.zeros((len(first), 3)), np.zeros(len(first)), np.zeros(len(first))
    for t in range(has.shape[1]):
        both = has[first, t] & has[second, t]
        away = positions[second, t] - positions[first, t]
        seen = np.einsum("eji,ej->ei", rotations[first, t], away) * both[:, None]
        total += seen
        square += (seen**2).sum(axis=1)
        count += both
    many = np.maximum(count, 1)
    offset = total / many[:, None]
    return _Shape(first, second, offset, np.sqrt(np.maximum(square / many - (offset**2).sum(axis=1), 0.0)))


def _rotations(positions: np.ndarray, shape: _Shape, edges: np.ndarray, depth_std: float) -> np.ndarray:
    """Turns (N, 3, 3) of all neighbourhoods in one frame that fit their shapes best (Kabsch 1976)."""
    i, j = shape.first[edges], shape.second[edges]
    w = 1 / (1 + (shape.spread[edges] / (_LOOSE * depth_std)) ** 2)
    products = ((positions[j] - positions[i]) * w[:, None])[:, :, None] * shape.offset[edges][:, None, :]
    gather = csr_matrix((np.ones(len(i)), (i, np.arange(len(i)))), (len(positions), len(i)))
    return nearest_rotation((gather @ products.reshape(len(i), 9)).reshape(-1, 3, 3))


def _weights(
    positions: np.ndarray, turn: np.ndarray, shape: _Shape, edges: np.ndarray, depth_std: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (F,) of companions in one frame, and the turned offsets (F, 3): those that don't keep them count less."""
    i, j = shape.first[edges], shape.second[edges]
    kept = np.einsum("eij,ej->ei", turn[i], shape.offset[edges])
    miss = ((positions[j] - positions[i] - kept) ** 2).sum(axis=1)
    scale = (_LOOSE * depth_std) ** 2
    return 1 / (1 + shape.spread[edges] ** 2 / scale) / (1 + miss / (4 * scale)), kept


def _shift(
    place: np.ndarray,
    positions: np.ndarray,
    directions: np.ndarray,
    kept: np.ndarray,
    weights: np.ndarray,
    shape: _Shape,
    edges: np.ndarray,
    depth_std: float,
) -> np.ndarray:
    """Shifts (N, 3) along the rays after which companions have their offsets, least squares over a frame."""
    N = len(place)
    i, j = shape.first[edges], shape.second[edges]
    w = weights * _FRACTION / _COMPANIONS / (_KEEPS * depth_std) ** 2
    one, other = directions[i], directions[j]
    miss = place[j] - place[i] - kept
    cross = -w * (one * other).sum(axis=1)
    depth = ((positions - place) * directions).sum(axis=1)
    hold = 1 / (1 + (depth / (_FAR * depth_std)) ** 2) / depth_std**2
    every = np.arange(N)
    values = np.concatenate([w * (one**2).sum(axis=1), w * (other**2).sum(axis=1), cross, cross, hold])
    rows, columns = np.concatenate([i, j, i, j, every]), np.concatenate([i, j, j, i, every])
    b = np.bincount(i, w * (one * miss).sum(axis=1), N) - np.bincount(j, w * (other * miss).sum(axis=1), N)
    found = spsolve(coo_matrix((values, (rows, columns)), (N, N)).tocsc(), b)
    return (found - depth)[:, None] * directions
