"""Inner loop of rendering: the light of the points that rays hit."""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def shade(triangle, uv, directions, faces, normals, colors, alpha, rim, key, above, rgba):
    """Colour and opacity of the points that rays hit: soft light, some from above, and a faint highlight.

    Parameters
    ----------
    triangle : (N,) int
    uv : (N, 2) float
        Barycentric coordinates of the second and third corner.
    directions : (N, 3) float
        Unit directions of the rays.
    faces : (F, 3) int
    normals : (V, 3) float
        Of the corners; they are turned towards the viewer.
    colors : (F, 3) float
        RGB 0–1.
    alpha, rim : (F,) float
        Opacity, and what is added to it where a surface is seen edge on.
    key, above : (3,) float
        Unit directions to the main light and to the sky.
    rgba : (N, 4) float
        Filled: colour and opacity, 0–1.
    """
    for n in range(len(triangle)):
        f = triangle[n]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u, v = uv[n, 0], uv[n, 1]
        w = 1.0 - u - v
        x = w * normals[a, 0] + u * normals[b, 0] + v * normals[c, 0]
        y = w * normals[a, 1] + u * normals[b, 1] + v * normals[c, 1]
        z = w * normals[a, 2] + u * normals[b, 2] + v * normals[c, 2]
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-9)
        facing = -scale * (x * dx + y * dy + z * dz)
        if facing < 0.0:
            facing, scale = -facing, -scale
        x, y, z = scale * x, scale * y, scale * z
        diffuse = min(max(x * key[0] + y * key[1] + z * key[2], 0.0), 1.0)
        sky = 0.5 + 0.5 * (x * above[0] + y * above[1] + z * above[2])
        hx, hy, hz = key[0] - dx, key[1] - dy, key[2] - dz
        shine = (x * hx + y * hy + z * hz) / math.sqrt(hx * hx + hy * hy + hz * hz)
        shine = min(max(shine, 0.0), 1.0)
        for _ in range(3):
            shine *= shine
        eighth = shine
        shine *= shine
        shine *= shine
        light = 0.30 + 0.16 * sky + 0.20 * min(facing, 1.0) + 0.44 * diffuse
        for k in range(3):
            rgba[n, k] = min(max(colors[f, k] * light + 0.10 * shine * eighth, 0.0), 1.0)
        edge = 1.0 - min(facing, 1.0)
        rgba[n, 3] = min(max(alpha[f] + rim[f] * edge * edge, 0.0), 1.0)
