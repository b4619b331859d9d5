"""Whether the coded blocks of a JPEG are whole.

Decoders go on over damaged blocks and fill the rest of a picture with what comes, with a word on the screen at best.
Here the codes of a baseline JPEG are followed without making a picture of them (ITU-T T.81, F.2): every code must be
one of its tables, all blocks must be there with nothing left over, and no coefficient may be larger than a picture of 8
bits has.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np

BASELINE = (0xC0, 0xC1)  # frames of sequential Huffman codes; of others only the markers are looked at
_LARGEST = 1024  # of a coefficient: eight times the half range of 8 bits
_FLAWS = ("", "a code that isn't in its tables", "data end early", "data are left over", "values beyond 8 bits")


@dataclass
class _Picture:
    """What the markers before a scan say."""

    quantization: dict[int, np.ndarray] = field(default_factory=dict)
    tables: dict[int, np.ndarray] = field(default_factory=dict)  # by class · 16 + number
    restart: int = 0
    width: int = 0
    height: int = 0
    baseline: bool = False
    components: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # horizontal, vertical, quantization


def jpeg_flaw(data: bytes) -> str:
    """Say what is wrong with the bytes of a JPEG file; empty if nothing is."""
    picture, at, scans = _Picture(), 2, 0
    try:
        while True:
            if data[at] != 0xFF:
                return f"no marker at byte {at:,}"
            while data[at] == 0xFF:
                at += 1
            marker, at = data[at], at + 1
            if marker == 0xD9:
                return "" if scans else "no picture in it"
            if marker == 0x01 or 0xD0 <= marker <= 0xD8:
                continue
            length = int.from_bytes(data[at : at + 2], "big")
            body = data[at + 2 : at + length]
            if length < 2 or len(body) != length - 2:
                return "data end early"
            at += length
            if marker == 0xDA:
                at, flaw = _scan(picture, body, data, at)
                if flaw:
                    return flaw
                scans += 1
            else:
                _note(picture, marker, body)
    except (IndexError, KeyError, ValueError):
        return "its markers are damaged" if at < len(data) else "data end early"


def _note(picture: _Picture, marker: int, body: bytes) -> None:
    """Take in what a marker says of the scans after it."""
    if marker == 0xDB:
        while body:
            wide, number = body[0] >> 4, body[0] & 15
            size = 64 * (1 + bool(wide))
            values = np.frombuffer(body[1 : 1 + size], ">u2" if wide else "u1").astype(np.int64)
            if len(values) != 64 or not values.all():
                raise ValueError
            picture.quantization[number], body = values, body[1 + size :]
    elif marker == 0xC4:
        while body:
            counts = np.frombuffer(body[1:17], np.uint8).astype(np.int64)
            total = int(counts.sum())
            symbols = np.frombuffer(body[17 : 17 + total], np.uint8)
            if len(counts) != 16 or len(symbols) != total:
                raise ValueError
            picture.tables[body[0]], body = _lookup(counts, symbols), body[17 + total :]
    elif marker == 0xDD:
        picture.restart = int.from_bytes(body[:2], "big")
    elif 0xC0 <= marker <= 0xCF and marker not in (0xC8, 0xCC):
        picture.baseline = marker in BASELINE and body[0] == 8
        picture.height, picture.width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
        picture.components = {
            body[6 + 3 * k]: (body[7 + 3 * k] >> 4, body[7 + 3 * k] & 15, body[8 + 3 * k]) for k in range(body[5])
        }
        if not all(0 < h <= 4 and 0 < v <= 4 for h, v, _ in picture.components.values()):
            raise ValueError


def _lookup(counts: np.ndarray, symbols: np.ndarray) -> np.ndarray:
    """Table by the next 16 bits: length of the code · 256 + symbol, 0 where none begins so; codes go upwards."""
    lengths = np.repeat(np.arange(1, 17), counts)
    spans = 1 << (16 - lengths)
    if spans.sum() > 1 << 16:
        raise ValueError
    table = np.zeros(1 << 16, np.int32)
    table[: spans.sum()] = np.repeat(lengths * 256 + symbols, spans)
    return table


def _scan(picture: _Picture, head: bytes, data: bytes, at: int) -> tuple[int, str]:
    """Follow the codes of a scan; where the next marker is, and what is wrong."""
    count = head[0]
    if not 1 <= count <= 4:
        raise ValueError
    chosen = [(head[1 + 2 * k], head[2 + 2 * k] >> 4, head[2 + 2 * k] & 15) for k in range(count)]
    own_tables = all(dc in picture.tables and 16 + ac in picture.tables for _, dc, ac in chosen)
    if not (picture.baseline and own_tables and picture.height):
        return _next_marker(data, at), ""
    sampling = [picture.components[c][:2] for c, _, _ in chosen]
    across, down = (max(s[axis] for s in map(_first_two, picture.components.values())) for axis in (0, 1))
    if count == 1:  # the blocks of one component stand by themselves
        h, v = sampling[0]
        columns, rows = -(-_part(picture.width, h, across) // 8), -(-_part(picture.height, v, down) // 8)
        blocks = [0]
    else:
        columns, rows = -(-picture.width // (8 * across)), -(-picture.height // (8 * down))
        blocks = [k for k, (h, v) in enumerate(sampling) for _ in range(h * v)]
    quantization = np.array([picture.quantization[picture.components[c][2]] for c, _, _ in chosen])
    dc = np.array([picture.tables[number] for _, number, _ in chosen])
    ac = np.array([picture.tables[16 + number] for _, _, number in chosen])
    block, flaw, end = follow_codes(
        np.frombuffer(data, np.uint8), at, columns * rows, np.array(blocks), dc, ac, quantization, picture.restart
    )
    if flaw:
        return end, f"{_FLAWS[flaw]} in row {block // columns + 1} of {rows} of its blocks"
    following = _next_marker(data, end)
    if data[end:following].strip(b"\0\xff"):
        return end, f"{_FLAWS[3]} behind its blocks"
    return following, ""


def _first_two(component: tuple[int, int, int]) -> tuple[int, int]:
    return component[:2]


def _part(size: int, factor: int, largest: int) -> int:
    return -(-size * factor // largest)


def _next_marker(data: bytes, at: int) -> int:
    """Where the next marker begins that ends a scan."""
    while True:
        at = data.find(b"\xff", at)
        if at < 0 or at + 1 >= len(data):
            raise IndexError
        if data[at + 1] not in (0x00, 0xFF) and not 0xD0 <= data[at + 1] <= 0xD7:
            return at
        at += 1


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
                while bits < 32:
                    byte = 0
                    if at + 1 < len(data) and (data[at] != 0xFF or data[at + 1] == 0):
                        byte = int(data[at])
                        at += 2 if byte == 0xFF else 1
                    else:
                        beyond += 8
                    held = ((held & 0xFFFFFFFFFF) << 8) | byte
                    bits += 8
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
