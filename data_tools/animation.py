"""Animated node hierarchies, as glTF has them: key frames to transforms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.asset import Pose


@dataclass(frozen=True)
class Channel:
    """One animated property of one node.

    Attributes
    ----------
    node : int
    path : str
        "translation", "rotation", "scale" or "weights".
    times : (K,) float
        Seconds, increasing.
    values : (K, n) float, or (K, 3, n) for CUBICSPLINE: in-tangent, value, out-tangent
        Rotations are unit quaternions x, y, z, w.
    interpolation : str
        "LINEAR", "STEP" or "CUBICSPLINE".
    """

    node: int
    path: str
    times: np.ndarray
    values: np.ndarray
    interpolation: str

    def at(self, time: float) -> np.ndarray:
        """Value at a time, held before the first and after the last key (glTF 2.0 specification, appendix C)."""
        times, cubic = self.times, self.interpolation == "CUBICSPLINE"
        if time <= times[0] or len(times) == 1:
            return self._value(0)
        if time >= times[-1]:
            return self._value(len(times) - 1)
        k = int(np.searchsorted(times, time, side="right")) - 1
        step = times[k + 1] - times[k]
        s = (time - times[k]) / step
        if self.interpolation == "STEP":
            return self._value(k)
        if cubic:
            before, after = self.values[k], self.values[k + 1]
            value = (
                (2 * s**3 - 3 * s**2 + 1) * before[1]
                + step * (s**3 - 2 * s**2 + s) * before[2]
                + (-2 * s**3 + 3 * s**2) * after[1]
                + step * (s**3 - s**2) * after[0]
            )
            return value / np.linalg.norm(value) if self.path == "rotation" else value
        if self.path == "rotation":
            return slerp(self.values[k], self.values[k + 1], s)
        return (1 - s) * self.values[k] + s * self.values[k + 1]

    def _value(self, key: int) -> np.ndarray:
        return self.values[key, 1] if self.interpolation == "CUBICSPLINE" else self.values[key]


def slerp(a: np.ndarray, b: np.ndarray, s: float) -> np.ndarray:
    """Interpolate two unit quaternions along the shorter great circle (K. Shoemake, SIGGRAPH 1985)."""
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    if cosine > 1 - 1e-9:
        mixed = (1 - s) * a + s * b
    else:
        angle = np.arccos(cosine)
        mixed = (np.sin((1 - s) * angle) * a + np.sin(s * angle) * b) / np.sin(angle)
    return mixed / np.linalg.norm(mixed)


def transform(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """T · R · S of a translation, a quaternion x, y, z, w and three scales: (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(rotation).as_matrix() * scale
    matrix[:3, 3] = translation
    return matrix


@dataclass(frozen=True)
class NodeTree:
    """A hierarchy of nodes and the clip that moves it. Calling it gives an asset's `Pose`.

    Attributes
    ----------
    parents : (N,) int
        -1 for roots.
    order : (N,) int
        Parents before children.
    matrices : (N, 4, 4) float
        Local transforms at rest.
    parts : tuple of N (translation (3,), rotation (4,), scale (3,))
        The same as parts.
    channels : tuple of Channel
    start : float
        Time of the clip's first key, seconds.
    joints : (J,) int
        The nodes that count as joints.
    morphs : tuple of (node, (M,) float)
        Nodes whose meshes have morph targets, and their weights at rest.
    """

    parents: np.ndarray
    order: np.ndarray
    matrices: np.ndarray
    parts: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]
    channels: tuple[Channel, ...]
    start: float
    joints: np.ndarray
    morphs: tuple[tuple[int, np.ndarray], ...]

    def __call__(self, time: float | None) -> Pose:
        """Pose `time` seconds after the clip's first key; the rest pose for None."""
        transforms = self.world(time)[self.joints]
        weights = {node: rest for node, rest in self.morphs}
        if time is not None:
            weights |= {c.node: c.at(time + self.start) for c in self.channels if c.path == "weights"}
        return Pose(transforms, np.concatenate([weights[node] for node, _ in self.morphs] or [np.zeros(0)]))

    def local(self, time: float | None) -> np.ndarray:
        """Transforms of all nodes in their parents, (N, 4, 4)."""
        if time is None:
            return self.matrices
        matrices = self.matrices.copy()
        changed: dict[int, dict[str, np.ndarray]] = {}
        for channel in self.channels:
            if channel.path != "weights":
                changed.setdefault(channel.node, {})[channel.path] = channel.at(time + self.start)
        for node, values in changed.items():
            t, r, s = self.parts[node]
            matrices[node] = transform(values.get("translation", t), values.get("rotation", r), values.get("scale", s))
        return matrices

    def world(self, time: float | None) -> np.ndarray:
        """Transforms of all nodes in the asset's axes, (N, 4, 4)."""
        matrices = self.local(time).copy()
        for node in self.order:
            if self.parents[node] >= 0:
                matrices[node] = matrices[self.parents[node]] @ matrices[node]
        return matrices
