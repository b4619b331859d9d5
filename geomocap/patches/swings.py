"""Pieces of the surface that moved too far from one frame to the next to be followed: lost, and looked for as a whole.

The patches on a kicking foot or a swung arm are lost together: carried on with what is beside them, they end up outside
the silhouettes. They were a rigid piece, which may now be anywhere on the surface that has no patches, turned any way;
`piece_search` finds out where.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geomocap.patches.frame_views import FrameViews
from geomocap.patches.piece_search import free_places, motion_of_piece
from geomocap.patches.surface_patches import PatchAlignment, Patches
from geomocap.scheduling import map_here

_LINK = 2.0  # spacings of the patches; lost ones nearer than that belong to the same piece
_LEAST = 18  # patches of a piece
_LOST_FRACTION = 0.5  # of the patches that were measured at a piece before, lost
_ASTRAY = 0.1  # fraction of a piece that must be outside the silhouettes, carried on with what is beside it
_LOOKS = 6  # frames in which a piece is looked for


@dataclass(frozen=True)
class LostPiece:
    """Patches that were lost together.

    Attributes
    ----------
    identity : (n,) int
    positions, frames : (n, 3), (n, 3, 3) float
        Where they were measured last, metres, world.
    looks : int
        Frames in which the piece has been looked for.
    """

    identity: np.ndarray
    positions: np.ndarray
    frames: np.ndarray
    looks: int = 0

    def select(self, which: np.ndarray) -> LostPiece:
        """Return it with some of its patches, by a mask or by positions."""
        return LostPiece(self.identity[which], self.positions[which], self.frames[which], self.looks)


def lost_pieces(
    patches: Patches, identity: np.ndarray, measured: np.ndarray, good: np.ndarray, spacing: float
) -> tuple[LostPiece, ...]:
    """Find the pieces that were lost from one frame to the next.

    Parameters
    ----------
    patches : Patches
        As they were in the frame before.
    identity : (N,) int
    measured, good : (N,) bool
        Whether they were measured in the frame before, and are in this.
    spacing : float
        Distance of patches, metres.
    """
    gone, stay = np.flatnonzero(measured & ~good), np.flatnonzero(measured & good)
    if len(gone) < _LEAST:
        return ()
    tree = cKDTree(patches.positions[gone])
    i, j = tree.query_pairs(_LINK * spacing, output_type="ndarray").T
    count, label = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (len(gone),) * 2), directed=False)
    distance, near = tree.query(patches.positions[stay], distance_upper_bound=spacing)
    beside = np.bincount(label[near[np.isfinite(distance)]], minlength=count)
    size = np.bincount(label, minlength=count)
    pieces = []
    for n in np.flatnonzero((size >= _LEAST) & (size >= _LOST_FRACTION * (size + beside))):
        own = gone[label == n]
        pieces.append(LostPiece(identity[own], patches.positions[own], patches.frames[own]))
    return tuple(pieces)


def find_pieces(
    pieces: tuple[LostPiece, ...],
    patches: Patches,
    identity: np.ndarray,
    good: np.ndarray,
    found: PatchAlignment,
    view: FrameViews,
    slack: np.ndarray,
    spacing: float,
) -> tuple[PatchAlignment, np.ndarray, tuple[LostPiece, ...]]:
    """Look for lost pieces in a frame.

    Parameters
    ----------
    pieces : tuple of LostPiece
    patches : Patches
        N patches as they were in the frame before.
    identity : (N,) int
    good : (N,) bool
        Patches that were found in the frame.
    found : PatchAlignment
        Where they all are, as far as known.
    view : FrameViews
    slack : (N, 1) float, metres
        Depth by which something must lie before a patch to hide it.
    spacing : float
        Distance of patches, metres.

    Returns
    -------
    found : PatchAlignment
        With the patches of pieces that were found where they must be.
    placed : (N,) bool
        Those patches.
    pieces : tuple of LostPiece
        Pieces to look for in the next frame: if these are found now, no patch of theirs is lost there.
    """
    placed = np.zeros(len(good), bool)
    asked: list[tuple[LostPiece, np.ndarray]] = []
    order = np.argsort(identity)
    positions, frames = found.positions.copy(), found.frames.copy()
    for piece in pieces:
        rows = order[np.searchsorted(identity, piece.identity, sorter=order).clip(0, len(identity) - 1)]
        lost = (identity[rows] == piece.identity) & ~good[rows]
        if lost.sum() < _LEAST or piece.looks >= _LOOKS:
            continue
        piece, rows = piece.select(lost), rows[lost]
        if piece.looks == 0 and view.may_be_subject(found.positions[rows]).mean() > 1 - _ASTRAY:
            continue
        asked.append((piece, rows))
    if not asked:
        return found, placed, ()
    places = free_places(found.positions[good], patches, view, spacing)

    def motion_now(piece: LostPiece, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        own = patches.select(rows).moved(piece.positions, piece.frames)
        return motion_of_piece(own, places, view, slack[rows], spacing)

    for (piece, rows), motion in zip(asked, map_here(lambda this: motion_now(*this), asked), strict=True):
        if motion is not None:
            turn, shift = motion
            positions[rows] = piece.positions @ turn.T + shift
            frames[rows] = turn @ piece.frames
            placed[rows] = True
    left = tuple(replace(piece, looks=piece.looks + 1) for piece, _ in asked)
    return found.at(positions, frames), placed, left
