"""Colours of pictures: one for each body, as `geomocap.model.palette` has them, and those that stand for no body."""

from __future__ import annotations

from geomocap.model.palette import BODY_COLORS, UNASSIGNED, body_color, body_colors, hex_color

__all__ = ["ACCENT", "BODY_COLORS", "INK", "UNASSIGNED", "body_color", "body_colors", "hex_color"]

INK = (34, 40, 49)
"""Text and outlines, RGB 0–255."""

ACCENT = (31, 95, 139)
"""Curves and lines that stand for no body, RGB 0–255."""
