"""Damages that once broke a reader, found by fuzzing: read again by every test run."""

from __future__ import annotations

FOUND: list[tuple[str, list[tuple[str, float, object]]]] = [
    # NaN that signal: arithmetic with them warns
    ("c3d", [("byte", 0.5, 0), ("over", 0.95703125, b"\xff")]),
    # headers of arrays that are no syntax
    ("skeleton.npz", [("byte", 0.130859375, 0)]),
    ("scan.npz", [("cut", 0.5, None), ("byte", 0.0, 0), ("double", 0.0, 67), ("drop", 0.0, 60)]),
    # a film in a code that libav has no decoder of
    ("video.webm", [("byte", 0.5, 0), ("double", 0.0, 107), ("byte", 0.25, 0)]),
    # times next to each other, and places beyond all measure: their quotients and squares overflow
    ("trc", [("put", 0.8647493576945331, b"1e-320")]),
    ("trc", [("byte", 0.3114668067754849, 69)]),
    # colours of 1e38: 255 times them overflow
    ("bodies.ply", [("drop", 0.1326346161446602, 16)]),
    # numbers that are infinite, and names that no file can have
    ("stage record", [("put", 0.9037598449471447, b"1e400")]),
    ("stage record", [("put", 0.8025455432872881, b"\\u0000")]),
    ("stage journal", [("over", 0.2227622221534421, b"1e400")]),
    ("stage journal", [("put", 0.559377446913149, b"\\u0000")]),
    # a component of no numbers, which Open3D reads all the same
    ("scan of text.pcd", [("byte", 0.05775862068965517, 48)]),
    # points without x, y, z
    ("bodies.ply", [("drop", 0.09694369466585184, 52)]),
    # a scan of no components
    ("jpg", [("zero", 0.375713640911547, 42)]),
]
