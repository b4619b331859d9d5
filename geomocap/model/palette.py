"""One colour per body, the same in every file and picture.

The first colours were ordered so that each new one is as far as possible from all before it, in OKLab, both for normal
ray and for simulated deuteranopia and protanopia (Machado, Oliveira, Fernandes 2009, severity 1).
"""

from __future__ import annotations

import numpy as np

UNASSIGNED = (176, 178, 182)
"""Grey of what belongs to no body (index -1), RGB 0–255."""

BODY_COLORS: tuple[tuple[int, int, int], ...] = (
    (0, 114, 178),
    (230, 130, 20),
    (150, 15, 45),
    (180, 225, 120),
    (210, 135, 240),
    (120, 225, 255),
    (0, 165, 135),
    (135, 105, 0),
    (105, 45, 135),
    (150, 90, 120),
    (120, 120, 225),
    (225, 180, 0),
    (0, 240, 195),
    (150, 180, 120),
    (75, 150, 195),
    (15, 90, 75),
    (75, 75, 180),
    (165, 135, 90),
    (180, 180, 240),
    (150, 45, 105),
    (210, 105, 180),
    (195, 75, 75),
    (120, 210, 165),
    (150, 60, 0),
)


def body_color(body: int) -> tuple[int, int, int]:
    """Return the colour of body number `body` as RGB 0–255; grey for negative numbers.

    Beyond the table, the colours come again, lighter and darker in turn.
    """
    if body < 0:
        return UNASSIGNED
    turn, index = divmod(int(body), len(BODY_COLORS))
    color = np.array(BODY_COLORS[index], dtype=float)
    if turn:
        strength = 0.45 * (1 - 0.6 ** ((turn + 1) // 2))
        color += (255.0 - color) * strength * 1.4 if turn % 2 else -color * strength
    r, g, b = np.clip(np.rint(color), 0, 255).astype(int).tolist()
    return r, g, b


def body_colors(bodies: np.ndarray) -> np.ndarray:
    """Return the colours of body numbers.

    Parameters
    ----------
    bodies : (N,) int
        Body numbers, -1 for none.

    Returns
    -------
    (N, 3) uint8, RGB
    """
    bodies = np.asarray(bodies, dtype=np.int64).ravel()
    top = int(bodies.max(initial=-1))
    table = np.array([UNASSIGNED, *(body_color(b) for b in range(top + 1))], dtype=np.uint8)
    return table[np.maximum(bodies, -1) + 1]


def hex_color(color: tuple[int, int, int]) -> str:
    """Return an RGB colour as `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*color)
