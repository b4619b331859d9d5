"""Animated files of other programs, and our own motion.glb, as contents of the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from geomocap.export.motion_tree import MotionTree
from viz.view_content import Content
from viz.view_shapes import MovingSurface

RATE = 30.0
"""Frames per second where the file's keys tell none."""

LONGEST = 3000
"""Frames at most; longer animations are shown at a lower rate."""


class Animation(Protocol):
    """What is needed of an animated surface: `data_tools.asset.AnimatedAsset` is one."""

    @property
    def faces(self) -> np.ndarray:
        """Triangles, (F, 3) int."""

    @property
    def vertex_weights(self) -> np.ndarray:
        """How much each joint moves each vertex, (V, J)."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of J joints."""

    @property
    def joint_parents(self) -> np.ndarray:
        """(J,) int, -1 for roots; parents stand before their children."""

    @property
    def duration(self) -> float:
        """Seconds; 0 if nothing moves."""

    @property
    def key_rate(self) -> float:
        """Key frames per second; 0 if not known."""

    def vertices(self, time: float | None) -> np.ndarray:
        """Vertices (V, 3) at a time in seconds, metres, z up."""

    def joint_transforms(self, time: float | None) -> tuple[np.ndarray, np.ndarray]:
        """Positions (J, 3) and world rotations (J, 3, 3) of the joints at a time."""


def of_animation(title: str, animation: Animation) -> Content:
    """Return an animated surface with its joints, at the rate of its keys.

    The surface is posed frame by frame by its own rules, so that morph targets and joints that scale are shown too.

    Parameters
    ----------
    title : str
    animation : Animation

    Raises
    ------
    MotionError
        If its joints make no tree.
    """
    seconds, fps = max(0.0, animation.duration), animation.key_rate or RATE
    fps = min(fps, (LONGEST - 1) / max(seconds, 1e-9))
    count = round(seconds * fps) + 1
    times = [min(t / fps, seconds) for t in range(count)]
    placed = [animation.joint_transforms(t) for t in times]
    p, R = (np.array(part) for part in zip(*placed, strict=True))
    parents, names = animation.joint_parents, _each_its_own(animation.joint_names)
    free = frozenset(np.flatnonzero(parents < 0)[1:].tolist())
    above = np.maximum(parents, 0)  # joints that hang on nothing move freely against the first
    above[0] = -1
    rotations, translations = R.copy(), p.copy()
    rotations[:, 1:] = np.einsum("tnji,tnjk->tnik", R[:, above[1:]], R[:, 1:])
    translations[:, 1:] = np.einsum("tnji,tnj->tni", R[:, above[1:]], p[:, 1:] - p[:, above[1:]])
    n = len(names)
    motion = MotionTree(
        names, above, translations[0], rotations, translations, np.ones(n, bool), np.full((n, 3), np.nan),
        np.arange(n), np.arange(n), fps, "z",
    )  # fmt: skip
    owner = np.argmax(animation.vertex_weights[animation.faces].sum(axis=1), axis=1)
    surface = MovingSurface(animation.faces, owner, lambda frame: animation.vertices(times[frame]))
    return Content(title, count, fps, "z", motion=motion, joint_names=names, surface=surface, free=free)


def _each_its_own(names: Sequence[str]) -> tuple[str, ...]:
    """Number names that come again."""
    found: dict[str, None] = {}
    for name in names:
        again = 2
        own = name
        while own in found:
            own, again = f"{name} {again}", again + 1
        found[own] = None
    return tuple(found)
