"""Bodies that hang on each other by ball joints and hinges, and what moves them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.model.hierarchy import Hierarchy

ROOT_DOF = 6


@dataclass(frozen=True)
class Linkage:
    """B bodies in a tree, each but the root connected to its parent by a joint that is fixed in both.

    All is given in one pose, the rest pose, in which every body's axes are the world's.

    Attributes
    ----------
    hierarchy : Hierarchy
    joints : (J, 3) float, metres
        Places of the joints at rest.
    axes : (J, 3) float
        Unit axes of the hinges at rest; not used for balls.
    hinge : (J,) bool
        Joints that turn about their axis only.
    origin : (3,) float, metres
        Point of the root body, at rest, whose path is the root's position.
    """

    hierarchy: Hierarchy
    joints: np.ndarray
    axes: np.ndarray
    hinge: np.ndarray
    origin: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.hierarchy.joint_bodies)
        expected = {"joints": (count, 3), "axes": (count, 3), "hinge": (count,), "origin": (3,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise GeometryError(f"linkage: {name} has shape {getattr(self, name).shape}, expected {shape}")

    @property
    def body_count(self) -> int:
        """Number of bodies B."""
        return len(self.joints) + 1

    @property
    def places(self) -> np.ndarray:
        """Point of each body at rest that it turns about, (B, 3), metres: the joint it hangs on; the root's origin."""
        places = np.empty((self.body_count, 3))
        places[self.hierarchy.root], places[self.hierarchy.joint_bodies[:, 1]] = self.origin, self.joints
        return places

    @property
    def joint_dof(self) -> np.ndarray:
        """First degree of freedom of each joint and, last, their number D: (J + 1,) int; the root has the first six."""
        return ROOT_DOF + np.concatenate([[0], np.cumsum(np.where(self.hinge, 1, 3))])

    def joint_positions(self, motion: BodyMotion) -> np.ndarray:
        """Positions of the joints, (T, J, 3), metres, world."""
        parents = self.hierarchy.joint_bodies[:, 0]
        return np.einsum("tjik,jk->tji", motion.rotations[:, parents], self.joints) + motion.translations[:, parents]

    def chains(self) -> np.ndarray:
        """Joints that move each body, (B, J) bool: those from the root to it."""
        result = np.zeros((self.body_count, len(self.joints)), bool)
        for j, (parent, child) in enumerate(self.hierarchy.joint_bodies):
            result[child] = result[parent]
            result[child, j] = True
        return result


@dataclass(frozen=True)
class JointMotion:
    """Motion of a linkage over T frames by its degrees of freedom.

    Attributes
    ----------
    local : (T, B, 3, 3) float
        Rotation of each body since rest in its parent's axes (parent from child); of the root, in world axes.
    root : (T, 3) float, metres, world
        Path of the linkage's origin.
    slip : (T, J, 3) float, metres, optional
        How far each child's end of a joint is from its parent's, in the parent's axes; none: joints hold.
    """

    local: np.ndarray
    root: np.ndarray
    slip: np.ndarray | None = None

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.root)

    def part(self, frames: slice) -> JointMotion:
        """Motion of some frames."""
        return JointMotion(self.local[frames], self.root[frames], None if self.slip is None else self.slip[frames])


@dataclass(frozen=True)
class BodyMotion:
    """Motion of each body: position(t) = rotation @ position at rest + translation.

    Attributes
    ----------
    rotations : (T, B, 3, 3) float
    translations : (T, B, 3) float, metres
    """

    rotations: np.ndarray
    translations: np.ndarray

    def part(self, frames: slice) -> BodyMotion:
        """Motion of some frames."""
        return BodyMotion(self.rotations[frames], self.translations[frames])

    def carry(self, points: np.ndarray, bodies: np.ndarray, fractions: np.ndarray) -> np.ndarray:
        """Positions (T, N, 3) of points (N, 3) at rest that follow some bodies each (linear blend).

        Parameters
        ----------
        points : (N, 3) float, metres
        bodies : (N, C) int
        fractions : (N, C) float
            They sum to one.
        """
        result = np.empty((len(self.rotations), len(points), 3))
        rotations, translations = (np.ascontiguousarray(a, float) for a in (self.rotations, self.translations))
        rest, shares = (np.ascontiguousarray(a, float) for a in (points, fractions))
        _carry(rotations, translations, rest, shares, np.ascontiguousarray(bodies, np.int32), result)
        return result


def body_motion(linkage: Linkage, motion: JointMotion) -> BodyMotion:
    """Motion of all bodies from the joints' (forward kinematics)."""
    tree, children = linkage.hierarchy, linkage.hierarchy.joint_bodies[:, 1]
    places = linkage.places
    offsets = np.repeat((places - places[np.maximum(tree.parents, 0)])[None], motion.frames, axis=0)
    offsets[:, tree.root] = motion.root
    if motion.slip is not None:
        offsets[:, children] += motion.slip
    rotations, origins = tree.forward_kinematics(motion.local, offsets)
    return BodyMotion(rotations, origins - np.einsum("tbij,bj->tbi", rotations, places))


def joint_motion(linkage: Linkage, rotations: np.ndarray, root: np.ndarray) -> JointMotion:
    """Degrees of freedom from the bodies' rotations; hinges keep their turn about the axis.

    Parameters
    ----------
    linkage : Linkage
    rotations : (T, B, 3, 3) float
        Since rest, world axes.
    root : (T, 3) float, metres
        Path of the linkage's origin.
    """
    local = rotations.copy()
    for j, (parent, child) in enumerate(linkage.hierarchy.joint_bodies):
        relative = np.swapaxes(rotations[:, parent], 1, 2) @ rotations[:, child]
        if linkage.hinge[j]:
            relative = about_axis(relative, linkage.axes[j])
        local[:, child] = relative
    return JointMotion(local, np.array(root, float))


def about_axis(rotations: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Rotations about an axis that are nearest to rotations (T, 3, 3): swing and twist, without the swing."""
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return Rotation.from_rotvec(
        2.0 * np.arctan2(quaternions[:, :3] @ axis, quaternions[:, 3])[:, None] * axis
    ).as_matrix()


def moved_by(linkage: Linkage, motion: JointMotion, step: np.ndarray) -> JointMotion:
    """Motion after a step of its degrees of freedom.

    Parameters
    ----------
    linkage : Linkage
    motion : JointMotion
    step : (T, D) or (T, D + 3 J) float
        Root: turn about its origin (radians, world axes), shift (metres); joints: turn (radians) in the parent's axes,
        of hinges about the axis; of joints that slip, their slips (metres) after all turns.
    """
    local = motion.local.copy()
    root = linkage.hierarchy.root
    local[:, root] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ local[:, root]
    first = linkage.joint_dof
    for j, child in enumerate(linkage.hierarchy.joint_bodies[:, 1]):
        turn = step[:, first[j] : first[j + 1]]
        vector = turn * linkage.axes[j] if linkage.hinge[j] else turn
        local[:, child] = Rotation.from_rotvec(vector).as_matrix() @ local[:, child]
    slip = None if motion.slip is None else motion.slip + step[:, first[-1] :].reshape(motion.slip.shape)
    return JointMotion(local, motion.root + step[:, 3:6], slip)


def posed(linkage: Linkage, motion: BodyMotion, frame: int) -> Linkage:
    """The linkage with the pose of a frame as its rest pose."""
    rotations, translations = motion.rotations[frame], motion.translations[frame]
    parents = linkage.hierarchy.joint_bodies[:, 0]
    root = linkage.hierarchy.root
    return replace(
        linkage,
        joints=np.einsum("jik,jk->ji", rotations[parents], linkage.joints) + translations[parents],
        axes=np.einsum("jik,jk->ji", rotations[parents], linkage.axes),
        origin=rotations[root] @ linkage.origin + translations[root],
    )


def since(motion: BodyMotion, frame: int) -> BodyMotion:
    """The same motion with the pose of a frame as rest."""
    rotations = motion.rotations @ motion.rotations[frame].swapaxes(1, 2)
    moved = np.einsum("tbij,bj->tbi", rotations, motion.translations[frame])
    return BodyMotion(rotations, motion.translations - moved)


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(rotations, translations, points, fractions, bodies, result):
    for t in range(len(rotations)):
        for n in range(len(points)):
            for i in range(3):
                total = 0.0
                for k in range(bodies.shape[1]):
                    b = bodies[n, k]
                    moved = translations[t, b, i]
                    for j in range(3):
                        moved += rotations[t, b, i, j] * points[n, j]
                    total += fractions[n, k] * moved
                result[t, n, i] = total
