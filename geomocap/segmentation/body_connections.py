"""Which bodies are connected: a tree of those that touch most."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.hierarchy import Hierarchy


def connect_bodies(contacts: np.ndarray, touching: np.ndarray, centers: np.ndarray, min_touching: float) -> Hierarchy:
    """Connect bodies into a tree (section 8; the paper leaves open how).

    It grows from the first body, found at the centre of gravity, each time by that pair of a body in it and one outside
    that has the most contact, of pairs that touch often enough (Prim's maximal spanning tree). Where none does, that
    which touches most often is taken, or else the nearest.

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
    often = touching >= max(min_touching, 1e-9)
    near = np.linalg.norm(centers[:, :, None] - centers[:, None], axis=-1).mean(axis=0)
    inside = np.arange(count) == 0
    pairs = []
    while not inside.all():
        within = np.flatnonzero(inside)[:, None], np.flatnonzero(~inside)
        wishes = (np.where(often, contacts, 0.0)[within], touching[within], 1.0 / (1.0 + near[within]))
        wish = next(w for w in wishes if w.any())
        parent, body = np.unravel_index(np.argmax(wish), wish.shape)
        pairs.append((within[0][parent, 0], within[1][body]))
        inside[pairs[-1][1]] = True
    return Hierarchy(0, np.array(pairs, np.int32).reshape(-1, 2))
