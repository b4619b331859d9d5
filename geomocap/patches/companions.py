"""Where lost patches are: among their companions, measured beside them when they were measured last.

What is nearest to a lost patch later on may be another limb, and motions that are added up from frame to frame drift.
Where a patch lay to its companions doesn't, as far as they are one piece: once some of a limb are measured again, all
of it is where it belongs. And what is taken for a lost patch must lie where its companions expect it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import njit

from geomocap.patches.patch_prediction import nearest
from geomocap.scheduling import spread

_COUNT = 12  # companions of a patch
_ENOUGH = 3  # companions whose places must be known
_RINGS = 8  # of lost patches, each one placed by those before
_ROUNDS = 5  # in which patches that too few companions bear out are left out
_FEW = 200  # patches that are not worth waking other threads for
_AHEAD = 1.5  # frames; what another motion would do in them counts as distance


@dataclass(frozen=True)
class Companions:
    """For each of N patches K others near it, and how it lay to them; −1 where there is none.

    Attributes
    ----------
    identity : (N, K) int
    places : (N, K, 3) float, metres
        The patch's position in the companion's patch frame.
    turns : (N, K, 3, 3) float
        The companion's frame from the patch's.
    """

    identity: np.ndarray
    places: np.ndarray
    turns: np.ndarray

    @classmethod
    def none(cls, count: int) -> Companions:
        """Return no companions of `count` patches."""
        K = _COUNT
        return cls(np.full((count, K), -1), np.zeros((count, K, 3)), np.zeros((count, K, 3, 3)))

    def select(self, which: np.ndarray) -> Companions:
        """Return those of some patches."""
        return Companions(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def join(self, other: Companions) -> Companions:
        """Return these followed by others'."""
        return Companions(
            **{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)}
        )

    def met(
        self,
        who: np.ndarray,
        among: np.ndarray,
        identity: np.ndarray,
        place: tuple[np.ndarray, np.ndarray],
        motion: tuple[np.ndarray, np.ndarray],
    ) -> Companions:
        """Return them with others for patches `who`: of those near, the ones that moved like them.

        Parameters
        ----------
        who, among : (A,), (B,) int
            Patches, and those that may be their companions; `who` belong to `among`.
        identity : (N,) int
        place : positions (N, 3), frames (N, 3, 3)
        motion : shifts (N, 3), metres, and turns (N, 3), rotation vectors, from frame to frame
        """
        (positions, frames), (shift, turn) = place, motion
        near = nearest(positions, who, among, 2 * _COUNT)
        if not near.size:
            return self
        arm = positions[who][:, None] - positions[near]
        unlike = shift[near] + np.cross(turn[near], arm) - shift[who][:, None]
        cost = np.linalg.norm(arm, axis=2) + _AHEAD * np.linalg.norm(unlike, axis=2)
        near = np.take_along_axis(near, np.argsort(cost, axis=1, kind="stable")[:, :_COUNT], axis=1)
        count = near.shape[1]
        back = np.swapaxes(frames[near], 2, 3)
        new = Companions(*(getattr(self, f.name).copy() for f in fields(self)))
        new.identity[who] = -1
        new.identity[who, :count] = identity[near]
        new.places[who, :count] = np.einsum("akij,akj->aki", back, positions[who][:, None] - positions[near])
        new.turns[who, :count] = back @ frames[who][:, None]
        return new

    def placed(
        self, identity: np.ndarray, known: np.ndarray, positions: np.ndarray, frames: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Place patches by companions that are known, then others by those.

        Each companion has a place for the patch: the most typical one counts.

        Parameters
        ----------
        identity : (N,) int
        known : (N,) bool
            Patches that are where positions (N, 3) and frames (N, 3, 3) say.
        positions, frames : (N, 3), (N, 3, 3) float

        Returns
        -------
        positions, frames : (N, 3), (N, 3, 3) float
        known : (N,) bool
            The rest stay as they are: fewer than three of their companions are known.
        """
        rows, there = self._rows(identity)
        X, Q, known = positions.copy(), frames.copy(), known.copy()
        for _ in range(_RINGS):
            todo = np.flatnonzero(~known)
            have = there[todo] & known[rows[todo]]
            enough = have.sum(axis=1) >= _ENOUGH
            todo, have = todo[enough], have[enough]
            if not len(todo):
                break
            near = rows[todo]
            spot = X[near] + np.einsum("akij,akj->aki", Q[near], self.places[todo])
            away = np.zeros((*have.shape, have.shape[1]))
            spread(_distances, len(todo), spot, have, away, few=_FEW)
            one, typical = np.arange(len(todo)), np.where(have, away.sum(axis=2), np.inf).argmin(axis=1)
            X[todo] = spot[one, typical]
            Q[todo] = Q[near[one, typical]] @ self.turns[todo, typical]
            known[todo] = True
        return X, Q, known

    def agreed(
        self,
        identity: np.ndarray,
        sure: np.ndarray,
        doubtful: np.ndarray,
        positions: np.ndarray,
        frames: np.ndarray,
        tolerance: np.ndarray,
    ) -> np.ndarray:
        """Find which doubtful patches lie where three companions expect them that are sure or so found themselves.

        Parameters
        ----------
        identity : (N,) int
        sure, doubtful : (N,) bool
        positions, frames : (N, 3), (N, 3, 3) float
        tolerance : (N,) float, metres

        Returns
        -------
        (N,) bool
        """
        rows, there = self._rows(identity)
        spot = positions[rows] + np.einsum("akij,akj->aki", frames[rows], self.places)
        near = there & (np.linalg.norm(spot - positions[:, None], axis=2) < tolerance[:, None])
        left = doubtful
        for _ in range(_ROUNDS):
            stay = left & ((near & (sure | left)[rows]).sum(axis=1) >= _ENOUGH)
            if (stay == left).all():
                break
            left = stay
        return left

    def _rows(self, identity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the companions are among patches `identity`, and whether they are there, both (N, K)."""
        row = np.full(max(identity.max(initial=-1), self.identity.max(initial=-1)) + 2, -1)
        row[identity] = np.arange(len(identity))
        rows = row[self.identity]  # nobody is the last one, −1
        return np.maximum(rows, 0), rows >= 0


@njit(cache=True, nogil=True, error_model="numpy")
def _distances(begin, end, spots, have, away):
    """Fill `away` (A, K, K) with the distances of spots (A, K, 3) from each other, of those that `have` (A, K)."""
    K = have.shape[1]
    for a in range(begin, end):
        for i in range(K):
            for j in range(K):
                if have[a, i] and have[a, j]:
                    square = 0.0
                    for k in range(3):
                        square += (spots[a, i, k] - spots[a, j, k]) ** 2
                    away[a, i, j] = np.sqrt(square)
