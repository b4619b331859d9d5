"""Colours of the pictures: those of the bodies, and the few that stand for no body."""

from geomocap.palette import BODY_COLORS, UNASSIGNED, body_color, body_colors, hex_color

INK = (34, 40, 49)
"""Text and outlines, RGB 0–255."""

ACCENT = (31, 95, 139)
"""Curves and lines that stand for no body, RGB 0–255."""

__all__ = ["ACCENT", "BODY_COLORS", "INK", "UNASSIGNED", "body_color", "body_colors", "hex_color"]
