"""The codes of a JPEG's scans, followed without making a picture of them (ITU-T T.81, F.2 and G.2).

Codes are followed until one is wrong; a flaw is a number of `FLAWS`.
"""

from __future__ import annotations

import numba
import numpy as np

FLAWS = (
    "",
    "a code that isn't in its tables",
    "data end early",
    "data are left over",
    "values beyond 8 bits",
    "empty blocks beyond the last one",
)
_LARGEST = 1024  # of a coefficient: eight times the half range of 8 bits


@numba.njit(nogil=True, cache=True)
def _more_bits(data: np.ndarray, at: int, held: int, bits: int, beyond: int) -> tuple[int, int, int, int]:
    """Take bytes until 32 bits are held, zeros where the data end; return where they end, and what is held."""
    while bits < 32:
        byte = 0
        if at + 1 < len(data) and (data[at] != 0xFF or data[at + 1] == 0):
            byte = int(data[at])
            at += 2 if byte == 0xFF else 1
        else:
            beyond += 8
        held = ((held & 0xFFFFFFFFFF) << 8) | byte
        bits += 8
    return at, held, bits, beyond


@numba.njit(nogil=True, cache=True, error_model="numpy")
def follow_codes(
    data: np.ndarray,
    at: int,
    units: int,
    blocks: np.ndarray,
    dc: np.ndarray,
    ac: np.ndarray,
    quantization: np.ndarray,
    restart: int,
) -> tuple[int, int, int]:
    """Follow the codes of a scan (T.81, F.2.2).

    Parameters
    ----------
    data : (N,) uint8
    at : int
        Where the codes begin.
    units : int
        Number of minimum coded units.
    blocks : (B,) int
        Component of each block of a unit.
    dc, ac : (C, 65536) int32
        Tables of each component.
    quantization : (C, 64) int
        In the order of the codes.
    restart : int
        Units between restart markers; 0: there are none.

    Returns
    -------
    unit, flaw, at : int
        Where it stopped, why (0: all is well), and the byte behind.
    """
    held, bits, beyond = 0, 0, 0  # of `held` the last `bits` bits are to be used, of which `beyond` aren't there
    before = np.zeros(len(dc), np.int64)
    for unit in range(units):
        if restart and unit and unit % restart == 0:
            if beyond > bits or bits - beyond >= 8:
                return unit, 2 if beyond > bits else 3, at
            if at + 1 >= len(data) or data[at] != 0xFF or data[at + 1] != 0xD0 + (unit // restart - 1) % 8:
                return unit, 3, at
            at, held, bits, beyond = at + 2, 0, 0, 0
            before[:] = 0
        for c in blocks:
            k = 0
            while k < 64:
                at, held, bits, beyond = _more_bits(data, at, held, bits, beyond)
                next16 = (held >> (bits - 16)) & 0xFFFF
                entry = int(dc[c, next16]) if k == 0 else int(ac[c, next16])
                if entry == 0:
                    return unit, 2 if beyond > bits - 16 else 1, at
                bits -= entry >> 8
                symbol = entry & 255
                size = symbol & 15
                if k:
                    if size == 0:
                        if symbol != 0xF0:
                            if symbol:
                                return unit, 1, at
                            break  # the rest of the block is zero
                        k += 16
                        continue
                    k += symbol >> 4
                    if k > 63:
                        return unit, 1, at
                elif symbol > 11:
                    return unit, 1, at
                value = (held >> (bits - size)) & ((1 << size) - 1)
                bits -= size
                if size and value < 1 << (size - 1):
                    value -= (1 << size) - 1
                if k == 0:
                    before[c] += value
                    value = before[c]
                if abs(value) * quantization[c, k] > _LARGEST + 2 * quantization[c, k] + 64:
                    return unit, 4, at
                k += 1
        if beyond > bits:
            return unit, 2, at
    if bits - beyond >= 8:
        return units - 1, 3, at
    return units - 1, 0, at


@numba.njit(nogil=True, cache=True, error_model="numpy")
def follow_progressive(
    data: np.ndarray,
    at: int,
    units: int,
    blocks: np.ndarray,
    tables: np.ndarray,
    quantization: np.ndarray,
    restart: int,
    band: tuple[int, int],
    refined: bool,
    low: int,
    known: np.ndarray,
) -> tuple[int, int, int]:
    """Follow the codes of a scan that gives some bits of some coefficients (T.81, G.2).

    Parameters
    ----------
    data, at, units, blocks, quantization, restart
        As for `follow_codes`.
    tables : (C, 65536) int32
        Table of each component; not used where coefficients 0 are refined.
    band : (int, int)
        First and last coefficient of the scan, in the order of the codes; only coefficient 0 if the first is 0.
    refined : bool
        Whether it gives one bit more of what earlier scans gave.
    low : int
        How many lower bits later scans give.
    known : (units,) uint64
        Of each block the coefficients that aren't zero, one bit each; noted here. Not used for coefficients 0.

    Returns
    -------
    unit, flaw, at : int
        As from `follow_codes`.
    """
    held, bits, beyond = 0, 0, 0
    run = 0  # blocks yet to come that have no new coefficients
    before = np.zeros(len(quantization), np.int64)
    for unit in range(units):
        if restart and unit and unit % restart == 0:
            if run:
                return unit, 5, at
            if beyond > bits or bits - beyond >= 8:
                return unit, 2 if beyond > bits else 3, at
            if at + 1 >= len(data) or data[at] != 0xFF or data[at + 1] != 0xD0 + (unit // restart - 1) % 8:
                return unit, 3, at
            at, held, bits, beyond = at + 2, 0, 0, 0
            before[:] = 0
        for c in blocks:
            k = band[0]
            if k == 0 and refined:
                at, held, bits, beyond = _more_bits(data, at, held, bits, beyond)
                bits -= 1
                continue
            if run and not refined:
                run -= 1
                continue
            while k <= band[1] and run == 0:
                at, held, bits, beyond = _more_bits(data, at, held, bits, beyond)
                entry = int(tables[c, (held >> (bits - 16)) & 0xFFFF])
                if entry == 0:
                    return unit, 2 if beyond > bits - 16 else 1, at
                bits -= entry >> 8
                zeros, size = (entry & 255) >> 4, entry & 15
                if k and size == 0 and zeros < 15:  # no new coefficients in this block and some more
                    run = (1 << zeros) + ((held >> (bits - zeros)) & ((1 << zeros) - 1))
                    bits -= zeros
                    break
                if (k == 0 and entry & 255 > 11) or (refined and size > 1):
                    return unit, 1, at
                value = (held >> (bits - size)) & ((1 << size) - 1)
                bits -= size
                if size and value < 1 << (size - 1):
                    value -= (1 << size) - 1
                if k == 0:
                    before[c] += value
                    value = before[c]
                elif refined:  # of those known already a bit each stands here; they aren't counted as zeros
                    while k <= band[1]:
                        if (known[unit] >> np.uint64(k)) & np.uint64(1):
                            at, held, bits, beyond = _more_bits(data, at, held, bits, beyond)
                            bits -= 1
                        elif zeros == 0:
                            break
                        else:
                            zeros -= 1
                        k += 1
                else:
                    k += zeros
                if size:
                    if k > band[1]:
                        return unit, 1, at
                    if abs(value << low) * quantization[c, k] > _LARGEST + (2 << low) * quantization[c, k] + 64:
                        return unit, 4, at
                    if k:
                        known[unit] |= np.uint64(1) << np.uint64(k)
                k += 1
            if run:
                while k <= band[1]:
                    if refined and (known[unit] >> np.uint64(k)) & np.uint64(1):
                        at, held, bits, beyond = _more_bits(data, at, held, bits, beyond)
                        bits -= 1
                    k += 1
                run -= 1
        if beyond > bits:
            return unit, 2, at
    if run:
        return units - 1, 5, at
    return units - 1, 3 if bits - beyond >= 8 else 0, at
