"""Whether the coded blocks of a JPEG are whole.

Decoders go on over damaged blocks and fill the rest of a picture with what comes, with a word on the screen at best.
Here the codes of a baseline or progressive JPEG are followed without making a picture of them: every code must be one
of its tables, all blocks must be there with nothing left over, no coefficient may be larger than a picture of 8 bits
has, and each scan of a progressive one must go on where those before it ended (ITU-T T.81, F.2 and G).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geomocap.files.jpeg_codes import FLAWS, follow_codes, follow_progressive

SEQUENTIAL, PROGRESSIVE = (0xC0, 0xC1), 0xC2  # frames of Huffman codes


@dataclass
class _Picture:
    """What the markers before a scan say."""

    quantization: dict[int, np.ndarray] = field(default_factory=dict)
    tables: dict[int, np.ndarray] = field(default_factory=dict)  # by class · 16 + number
    restart: int = 0
    width: int = 0
    height: int = 0
    frame: int = 0
    bits: int = 0
    components: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # horizontal, vertical, quantization
    missing: dict[int, np.ndarray] = field(default_factory=dict)  # (64,) lower bits yet to come; -1: all, 0: none
    known: dict[int, np.ndarray] = field(default_factory=dict)  # of each block the coefficients that aren't zero


@dataclass(frozen=True)
class _Scan:
    """What the head of a scan says."""

    components: list[int]
    dc: list[int]  # numbers of tables
    ac: list[int]
    band: tuple[int, int]  # first and last coefficient
    before: int  # lower bits that earlier scans have left, 0 if there are none
    low: int  # lower bits left to later ones

    @classmethod
    def of(cls, head: bytes) -> _Scan:
        """Take the head of a scan apart; raises IndexError or ValueError."""
        count = head[0]
        if not 1 <= count <= 4:
            raise ValueError
        components, numbers = [head[1 + 2 * k] for k in range(count)], [head[2 + 2 * k] for k in range(count)]
        first, last, bits = head[1 + 2 * count], head[2 + 2 * count], head[3 + 2 * count]
        ac = [16 + (n & 15) for n in numbers]
        return cls(components, [n >> 4 for n in numbers], ac, (first, last), bits >> 4, bits & 15)


def jpeg_flaw(data: bytes) -> str:
    """Say what is wrong with the bytes of a JPEG file; empty if nothing is."""
    picture, at = _Picture(), 2
    try:
        while True:
            if data[at] != 0xFF:
                return f"no marker at byte {at:,}"
            while data[at] == 0xFF:
                at += 1
            marker, at = data[at], at + 1
            if marker == 0xD9:
                whole = picture.frame and picture.components.keys() == picture.missing.keys()
                return "" if whole else "no whole picture in it"
            if marker == 0x01 or 0xD0 <= marker <= 0xD8:
                continue
            if 0xC0 <= marker <= 0xCF and marker not in (*SEQUENTIAL, PROGRESSIVE, 0xC4, 0xC8, 0xCC):
                return f"of a kind that isn't read, SOF{marker - 0xC0}"
            length = int.from_bytes(data[at : at + 2], "big")
            body = data[at + 2 : at + length]
            if length < 2 or len(body) != length - 2:
                return "data end early"
            at += length
            if marker == 0xDA:
                at, flaw = _follow(picture, _Scan.of(body), data, at)
                if flaw:
                    return flaw
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
    elif marker in (*SEQUENTIAL, PROGRESSIVE):
        if picture.frame:
            raise ValueError
        picture.frame, picture.bits = marker, body[0]
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


def _follow(picture: _Picture, scan: _Scan, data: bytes, at: int) -> tuple[int, str]:
    """Follow the codes of a scan; where the next marker is, and what is wrong."""
    columns, rows, blocks = _blocks(picture, scan.components)
    units, values = columns * rows, np.frombuffer(data, np.uint8)
    quantization = np.array([picture.quantization[picture.components[c][2]] for c in scan.components])
    if picture.frame == PROGRESSIVE:
        _go_on(picture, scan)
    else:
        picture.missing |= dict.fromkeys(scan.components, np.zeros(64, np.int64))
    if picture.bits != 8 or not (picture.frame == PROGRESSIVE or picture.tables.keys() >= {*scan.dc, *scan.ac}):
        return _next_marker(data, at), ""
    if picture.frame == PROGRESSIVE:
        tables = _tables(picture, scan.ac if scan.band[0] else [] if scan.before else scan.dc)
        known = np.zeros(0, np.uint64)
        if scan.band[0]:  # of one component, so its blocks are the same in each such scan
            known = picture.known.setdefault(scan.components[0], np.zeros(units, np.uint64))
        part = scan.band, scan.before > 0, scan.low
        block, flaw, end = follow_progressive(
            values, at, units, blocks, tables, quantization, picture.restart, *part, known
        )
    else:
        dc, ac = _tables(picture, scan.dc), _tables(picture, scan.ac)
        block, flaw, end = follow_codes(values, at, units, blocks, dc, ac, quantization, picture.restart)
    if flaw:
        return end, f"{FLAWS[flaw]} in row {block // columns + 1} of {rows} of its blocks"
    following = _next_marker(data, end)
    if data[end:following].strip(b"\0\xff"):
        return end, f"{FLAWS[3]} behind its blocks"
    return following, ""


def _blocks(picture: _Picture, components: list[int]) -> tuple[int, int, np.ndarray]:
    """Columns and rows of the units of a scan, and the component of each block of a unit."""
    sampling = [picture.components[c][:2] for c in components]
    across, down = (max(s[axis] for s in map(_first_two, picture.components.values())) for axis in (0, 1))
    if len(components) == 1:  # the blocks of one component stand by themselves
        h, v = sampling[0]
        return -(-_part(picture.width, h, across) // 8), -(-_part(picture.height, v, down) // 8), np.zeros(1, np.int64)
    blocks = [k for k, (h, v) in enumerate(sampling) for _ in range(h * v)]
    return -(-picture.width // (8 * across)), -(-picture.height // (8 * down)), np.array(blocks)


def _tables(picture: _Picture, numbers: list[int]) -> np.ndarray:
    return np.array([picture.tables[number] for number in numbers], np.int32).reshape(len(numbers), 1 << 16)


def _go_on(picture: _Picture, scan: _Scan) -> None:
    """Note which bits a scan of a progressive picture gives; raises ValueError if they aren't the next ones."""
    first, last = scan.band
    one_component = len(scan.components) == 1 and first <= last < 64
    if not (one_component if first else last == 0) or scan.low > 13 or scan.before not in (0, scan.low + 1):
        raise ValueError
    for component in scan.components:
        missing = picture.missing.setdefault(component, np.full(64, -1))
        band = missing[first : last + 1]
        if (first and missing[0] < 0) or (np.maximum(band, 0) != scan.before).any():
            raise ValueError
        band[:] = scan.low


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
