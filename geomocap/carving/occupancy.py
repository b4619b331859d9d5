"""Occupied voxels of a grid, one bit each: small enough to clear, scan and compare in well under a millisecond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.scheduling import spread


@dataclass(frozen=True)
class Occupancy:
    """Which voxels of a grid are occupied.

    Attributes
    ----------
    bits : (X, Y, ceil(Z / 32)) uint32
        Bit k of word w stands for z index 32 w + k; bits beyond Z are 0.
    shape : (X, Y, Z) int
    """

    bits: np.ndarray
    shape: tuple[int, int, int]

    @classmethod
    def empty(cls, shape: tuple[int, int, int]) -> Occupancy:
        """Return an occupancy without any voxel."""
        return cls(np.zeros((shape[0], shape[1], (shape[2] + 31) // 32), np.uint32), shape)

    @classmethod
    def of_dense(cls, dense: np.ndarray) -> Occupancy:
        """Take over an array (X, Y, Z), occupied where not 0."""
        X, Y, Z = dense.shape
        padded = np.zeros((X, Y, (Z + 31) // 32 * 32), np.uint8)
        padded[:, :, :Z] = dense != 0
        return cls(np.packbits(padded, axis=2, bitorder="little").view("<u4").astype(np.uint32), (X, Y, Z))

    def dense(self, out: np.ndarray | None = None) -> np.ndarray:
        """Return the voxels as (X, Y, Z) uint8, 1 where occupied.

        Parameters
        ----------
        out : (X, Y, Z) uint8, optional
            Array to fill and return; every voxel of it is written.
        """
        if out is None:
            out = np.zeros(self.shape, np.uint8)
            spread(_unpack, len(out), self.bits, out, False)
        else:
            spread(_unpack, len(out), self.bits, out, True)
        return out

    def surface(self) -> Occupancy:
        """Return the occupied voxels that have an empty one among their six neighbours, or lie on the grid's border."""
        bits, _ = _surface(self.bits)
        return Occupancy(bits, self.shape)

    def surface_indices(self) -> np.ndarray:
        """Return the surface voxels, (N, 3) int32, sorted by x, y, z index."""
        return _indices(*_surface(self.bits))

    def indices(self) -> np.ndarray:
        """Return the occupied voxels, (N, 3) int32, sorted by x, y, z index."""
        return _indices(self.bits, _slab_counts(self.bits))

    def count(self) -> int:
        """Return the number of occupied voxels."""
        return int(_slab_counts(self.bits).sum())


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _popcount(word):
    word = np.uint64(word)
    word = word - ((word >> np.uint64(1)) & np.uint64(0x55555555))
    word = (word & np.uint64(0x33333333)) + ((word >> np.uint64(2)) & np.uint64(0x33333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F)
    return np.int64(((word * np.uint64(0x01010101)) & np.uint64(0xFFFFFFFF)) >> np.uint64(24))


@njit(cache=True, nogil=True, error_model="numpy")
def _slab_counts(bits):
    """Count the set bits of every x index."""
    X, Y, K = bits.shape
    counts = np.zeros(X, np.int64)
    for i in range(X):
        for j in range(Y):
            for k in range(K):
                if bits[i, j, k]:
                    counts[i] += _popcount(bits[i, j, k])
    return counts


@njit(cache=True, nogil=True, error_model="numpy")
def _slab_surface(i, bits, surface, counts):
    """Keep the bits of x index i with an unset one among their six neighbours, and count them; filled in place."""
    X, Y, K = bits.shape
    count = 0
    for j in range(Y):
        border = i == 0 or j == 0 or i == X - 1 or j == Y - 1
        for k in range(K):
            word = bits[i, j, k]
            if word == 0:
                continue
            rest = word
            if not border:
                below = np.uint32(word << np.uint32(1))
                if k > 0:
                    below |= np.uint32(bits[i, j, k - 1] >> np.uint32(31))
                above = np.uint32(word >> np.uint32(1))
                if k < K - 1:
                    above |= np.uint32(bits[i, j, k + 1] << np.uint32(31))
                inner = below & above & bits[i - 1, j, k] & bits[i + 1, j, k] & bits[i, j - 1, k] & bits[i, j + 1, k]
                rest = np.uint32(word & ~inner)
            surface[i, j, k] = rest
            count += _popcount(rest)
    counts[i] = count


@njit(cache=True, nogil=True, error_model="numpy")
def _slab_surfaces(begin, end, bits, surface, counts):
    for i in range(begin, end):
        _slab_surface(i, bits, surface, counts)


def _surface(bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bits with an unset one among their six neighbours, and how many there are at every x index."""
    surface, counts = np.zeros_like(bits), np.zeros(len(bits), np.int64)
    spread(_slab_surfaces, len(bits), bits, surface, counts)
    return surface, counts


@njit(cache=True, nogil=True, error_model="numpy")
def _indices(bits, counts):
    """List the set bits, in order; `counts` are those of every x index."""
    X, Y, K = bits.shape
    out = np.empty((counts.sum(), 3), np.int32)
    n = 0
    for i in range(X):
        if counts[i] == 0:
            continue
        for j in range(Y):
            for k in range(K):
                word = bits[i, j, k]
                while word != 0:
                    rest = np.uint32(word & np.uint32(word - np.uint32(1)))  # without the lowest bit
                    out[n, 0] = i
                    out[n, 1] = j
                    out[n, 2] = 32 * k + _popcount((word ^ rest) - np.uint32(1))
                    n += 1
                    word = rest
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _unpack(begin, end, bits, out, clear):
    """Write the bits into bytes; zeros only if `clear`."""
    Y, K = bits.shape[1:]
    Z = out.shape[2]
    for i in range(begin, end):
        for j in range(Y):
            for k in range(K):
                word = bits[i, j, k]
                low, high = 32 * k, min(32 * k + 32, Z)
                if word == 0:
                    if clear:
                        out[i, j, low:high] = 0
                elif word == np.uint32(0xFFFFFFFF):
                    out[i, j, low:high] = 1
                else:
                    for z in range(low, high):
                        out[i, j, z] = (word >> np.uint32(z - low)) & np.uint32(1)
