"""Which bodies are connected: a tree from their contacts and the order in which they were found."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.hierarchy import Hierarchy


def connect_bodies(contacts: np.ndarray, touching: np.ndarray, centers: np.ndarray, min_touching: float) -> Hierarchy:
    """Connect bodies into a tree (section 8; the paper leaves open how).

    Bodies are numbered in the order in which they were found, which walks along limbs. A body found later is connected
    to one found before it: that with the most contact, among those it touches often enough. The first body, found at
    the centre of gravity, is the root. Connections only go back in the order, so there are no cycles. A body that
    touches no earlier one often enough is connected to the one that it touches most often, or else to the nearest.

    Parameters
    ----------
    contacts : (B, B) float
        Neighbouring pairs of points, mean over the frames.
    touching : (B, B) float
        Fraction of the frames in which two bodies touch.
    centers : (T, B, 3) float, metres
    min_touching : float
        Fraction of the frames in which connected bodies touch.

    Raises
    ------
    GeometryError
        If there are no bodies.
    """
    count = len(contacts)
    if count == 0:
        raise GeometryError("no rigid bodies to connect: at least two frames with motion are needed")
    parents = np.full(count, -1)
    for body in range(1, count):
        earlier = np.arange(body)
        often = touching[body, earlier] >= max(min_touching, 1e-9)
        if often.any():
            parents[body] = np.argmax(np.where(often, contacts[body, earlier], -1.0))
        elif touching[body, earlier].any():
            parents[body] = np.argmax(touching[body, earlier])
        else:
            parents[body] = np.argmin(np.linalg.norm(centers[:, earlier] - centers[:, [body]], axis=-1).mean(axis=0))
    pairs = [(parents[body], body) for body in range(1, count)]
    return Hierarchy(0, np.array(pairs, np.int32).reshape(-1, 2))
