"""The truth of a synthetic capture, and the rigid bodies that its motion really has."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from geomocap.errors import GeometryError, RunError
from geomocap.evaluation.result import EvaluationError
from geomocap.files.array_schema import FPS, Expected, check_arrays
from geomocap.files.npz import read_npz
from geomocap.model.ray_casting import TriangleScene
from geomocap.model.rotations import relative_turns, turn_angles

ACTIVE_DEG = 15.0  # a rig joint is active when its segment turns at least this much against its parent segment
MIN_FRACTION = 0.012  # a segment with a smaller fraction of the surface (fingers, eyes) belongs to its parent's body
HEIGHTS = (0.01, 100.0)  # m; subjects beyond are in other units

SHAPES = {
    "vertices": ("T", "V", 3),
    "faces": ("F", 3),
    "vertex_joint": ("V",),
    "joint_names": ("J",),
    "joint_parents": ("J",),
    "joint_positions": ("T", "J", 3),
    "joint_rotations": ("T", "J", 3, 3),
}

SCHEMA = {
    "vertices": Expected("T V 3", low=-1e6, high=1e6),
    "joint_positions": Expected("T J 3", low=-1e6, high=1e6),
    "joint_rotations": Expected("T J 3 3", "rotation"),
    "joint_names": Expected("J", "text"),
    "joint_parents": Expected("J", "whole", low=-1, high="J"),
    "faces": Expected("F 3", "whole", low=0, high="V"),
    "vertex_joint": Expected("V", "whole", low=0, high="J"),
    "vertex_weights": Expected("V J", low=0, high=1.01),
    "fps": FPS,
}


@dataclass(frozen=True)
class TrueBodies:
    """Rig joints grouped into the rigid bodies that move against each other.

    Attributes
    ----------
    of_joint : (J,) int
        Body of each rig joint.
    root : (B,) int
        Rig joint that each body begins at.
    parent : (B,) int
        Parent body, -1 for roots.
    """

    of_joint: np.ndarray
    root: np.ndarray
    parent: np.ndarray

    def __len__(self) -> int:
        return len(self.root)

    @property
    def jointed(self) -> np.ndarray:
        """Bodies with a joint to a parent, where its first rig joint lies: all but the roots, int."""
        return np.flatnonzero(self.parent >= 0)


@dataclass(frozen=True)
class Truth:
    """What `truth.npz` holds: a mesh and its rig in motion, metres, world.

    Attributes
    ----------
    fps : float
    vertices : (T, V, 3) float
    faces : (F, 3) int
    vertex_joint : (V,) int
        The rig joint that moves a vertex most.
    vertex_weights : (V, J) float or None
    joint_names : (J,) str
    joint_parents : (J,) int
    joint_positions : (T, J, 3) float
    joint_rotations : (T, J, 3, 3) float
        World from joint.
    """

    fps: float
    vertices: np.ndarray
    faces: np.ndarray
    vertex_joint: np.ndarray
    vertex_weights: np.ndarray | None
    joint_names: np.ndarray
    joint_parents: np.ndarray
    joint_positions: np.ndarray
    joint_rotations: np.ndarray

    @classmethod
    def read(cls, path: Path) -> Truth:
        """Read the truth from its folder, or from the file itself.

        Raises
        ------
        EvaluationError
            If the file is missing, damaged, lacks arrays, or holds NaN, no frames or lengths that are no metres.
        """
        file = path / "truth.npz" if path.is_dir() else path
        if not file.is_file():
            raise EvaluationError(f"{file}: missing; a truth is a folder with truth.npz, or a motion file")
        try:
            arrays = read_npz(file)
        except RunError as error:
            why = str(error).removeprefix(f"{file}: ").partition(";")[0]
            raise EvaluationError(f"{file}: {why}; make it again") from None
        _check(arrays, file)
        weights = arrays.get("vertex_weights")
        return cls(
            float(arrays["fps"]),
            arrays["vertices"].astype(float),
            arrays["faces"].astype(int),
            arrays["vertex_joint"].astype(int),
            None if weights is None else weights.astype(float),
            arrays["joint_names"],
            arrays["joint_parents"].astype(int),
            arrays["joint_positions"].astype(float),
            arrays["joint_rotations"].astype(float),
        )

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.vertices)

    @cached_property
    def height(self) -> float:
        """Extent along z in the first frame, metres; all relative figures refer to it."""
        return float(np.ptp(self.vertices[0][:, 2]))

    @cached_property
    def bodies(self) -> TrueBodies:
        """The rigid bodies that the motion shows."""
        return true_bodies(self)

    @cached_property
    def body_weights(self) -> np.ndarray | None:
        """Skin weights summed over each body's joints, (V, B)."""
        if self.vertex_weights is None:
            return None
        weights = np.zeros((len(self.vertex_joint), len(self.bodies)))
        np.add.at(weights.T, self.bodies.of_joint, self.vertex_weights.T)
        return weights

    def surface(self, frame: int) -> TriangleScene:
        """Return the surface of a frame, for finding closest points."""
        return TriangleScene(self.vertices[frame], self.faces)


def true_bodies(truth: Truth) -> TrueBodies:
    """Group rig joints into rigid bodies by the motion that is really there.

    From the root outwards, a joint begins a body of its own when its segment turns at least `ACTIVE_DEG` against the
    body before it (largest angle since the first frame), and both have more than `MIN_FRACTION` of the surface.
    """
    parents, n = truth.joint_parents, len(truth.joint_parents)
    fraction = _surface_fraction(truth)
    order = _parents_first(parents)
    subtree = fraction.copy()
    for j in reversed(order):
        if parents[j] >= 0:
            subtree[parents[j]] += subtree[j]
    of_joint = np.full(n, -1)
    root: list[int] = []
    parent_body: list[int] = []
    surface: list[float] = []
    for j in order:
        above = of_joint[parents[j]] if parents[j] >= 0 else -1
        if above >= 0 and not (
            _largest_turn_deg(truth.joint_rotations, root[above], j) >= ACTIVE_DEG
            and subtree[j] >= MIN_FRACTION
            and surface[above] >= MIN_FRACTION
        ):
            of_joint[j] = above
            surface[above] += fraction[j]
            continue
        of_joint[j] = len(root)
        root.append(j)
        parent_body.append(above)
        surface.append(fraction[j])
    return TrueBodies(of_joint, np.array(root), np.array(parent_body))


def _surface_fraction(truth: Truth) -> np.ndarray:
    """Fraction of the surface, in the first frame, that each rig joint moves most."""
    corner = truth.vertices[0][truth.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    joint = truth.vertex_joint[truth.faces[:, 0]]
    return np.bincount(joint, area, len(truth.joint_parents)) / area.sum()


def _parents_first(parents: np.ndarray) -> list[int]:
    """Joints in sweeps from the roots outwards, each sweep in the order of their numbers."""
    order: list[int] = []
    seen: set[int] = set()
    while len(order) < len(parents):
        before = len(order)
        for j in range(len(parents)):
            if j not in seen and (parents[j] < 0 or int(parents[j]) in seen):
                order.append(j)
                seen.add(j)
        if len(order) == before:
            raise EvaluationError("truth: joint_parents makes a loop")
    return order


def _largest_turn_deg(rotations: np.ndarray, reference: int, joint: int) -> float:
    relative = relative_turns(rotations[:, reference], rotations[:, joint])
    since_first = np.einsum("ij,tkj->tik", relative[0], relative)
    return float(np.rad2deg(turn_angles(since_first)).max())


def _numbers(values: np.ndarray, name: str, file: Path) -> np.ndarray:
    if values.dtype.kind not in "fiu":
        raise EvaluationError(f"{file}: {name} holds no numbers")
    return values


def _check(arrays: dict[str, np.ndarray], file: Path) -> None:
    missing = [k for k in ("fps", *SHAPES) if k not in arrays]
    if missing:
        raise EvaluationError(f"{file}: has no array {', '.join(missing)}; it is no truth")
    size: dict[str, int] = {}
    for name, shape in SHAPES.items():
        got = arrays[name].shape
        for n, s in zip(got, shape, strict=False):
            if (n != size.setdefault(s, n)) if isinstance(s, str) else n != s:
                raise EvaluationError(
                    f"{file}: {name} has shape {got}, which doesn't fit the other arrays; make it again"
                )
        if len(got) != len(shape) or 0 in got:
            raise EvaluationError(f"{file}: {name} has shape {got}, expected {' × '.join(map(str, shape))}, none empty")
    for name in ("vertices", "joint_positions", "joint_rotations"):
        good = np.isfinite(_numbers(arrays[name], name, file)).reshape(len(arrays[name]), -1).all(axis=1)
        if not good.all():
            raise EvaluationError(f"{file}: {name} holds NaN or infinity in frame {int(np.argmin(good))}")
    try:
        check_arrays(arrays, SCHEMA)
    except GeometryError as error:
        raise EvaluationError(f"{file}: {error}; make it again") from None
    names = [str(n) for n in arrays["joint_names"]]
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise EvaluationError(f"{file}: two rig joints are called {twice}; give each its own name")
    height = float(np.ptp(arrays["vertices"][0][:, 2]))
    if not HEIGHTS[0] <= height <= HEIGHTS[1]:
        raise EvaluationError(f"{file}: the subject is {height:g} m high; the truth's lengths must be metres")
