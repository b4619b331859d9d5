"""Where the world is: origin, axes and floor of a calibration, and how they were found.

Images of a bar leave the world's frame open. It is fixed by bars laid on the floor, by points of known position (an
L-shaped reference, say), by a camera's direction of gravity or by an existing calibration. If nothing is given, the
cameras' mean upward direction and the lowest bar end have to do, and the result says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import permutations

import numpy as np

from geomocap.calibration.network import Network
from geomocap.calibration.orientation import ideal_coordinates
from geomocap.calibration.projection import interior_of
from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig
from geomocap.model.rotations import rigid_motion
from geomocap.model.triangulation import nearest_to_rays

AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Datum:
    """A rigid motion into the world and where it comes from.

    Attributes
    ----------
    rotation : (3, 3) float
    translation : (3,) float
        x_world = rotation x + translation, metres.
    source : str
        What fixed the world, in words.
    warnings : tuple of str
    """

    rotation: np.ndarray
    translation: np.ndarray
    source: str
    warnings: tuple[str, ...] = field(default=())

    def apply(self, network: Network) -> Network:
        """Return the network in this world."""
        return network.transformed(self.rotation, self.translation)


def datum_from_axes(
    up_direction: np.ndarray,
    origin: np.ndarray,
    forward: np.ndarray,
    up: str,
    source: str,
    warnings: tuple[str, ...] = (),
) -> Datum:
    """Make a datum from an upward direction, a point that becomes the origin and a horizontal direction.

    Parameters
    ----------
    up_direction : (3,) float
        Becomes the axis `up`.
    origin : (3,) float
    forward : (3,) float
        Its horizontal part becomes the axis after `up` in the order x, y, z, x.
    up : {"x", "y", "z"}
    """
    u = up_direction / np.linalg.norm(up_direction)
    f = forward - u * float(np.dot(u, forward))
    if np.linalg.norm(f) < 1e-6 * max(float(np.linalg.norm(forward)), 1e-12):
        f = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
    f = f / np.linalg.norm(f)
    k = AXES[up]
    rotation = np.zeros((3, 3))
    rotation[k] = u
    rotation[(k + 1) % 3] = f
    rotation[(k + 2) % 3] = np.cross(u, f)
    return Datum(rotation, -rotation @ origin, source, warnings)


def rough_up(network: Network) -> np.ndarray:
    """Mean upward direction of the cameras, which are held upright more or less."""
    up = -network.rotation[:, 1].mean(axis=0)
    if np.linalg.norm(up) < 0.2:
        # Looking down steeply from around: their positions are above what they look at
        up = -network.rotation[:, 2].mean(axis=0)
    return up / np.linalg.norm(up)


def datum_from_cameras(network: Network, up: str) -> Datum:
    """Take the cameras' mean upward direction, the lowest bar end as the floor, the bars' middle as the origin."""
    u = rough_up(network)
    ends = network.bars.reshape(-1, 3)
    middle = ends.mean(axis=0)
    origin = middle + u * float(((ends - middle) @ u).min())
    warning = (
        "nothing fixes the world: the cameras' mean upward direction was taken as up and the lowest bar end as floor; "
        "lay the bar on the floor in two directions and name those frames (--floor)"
    )
    return datum_from_axes(u, origin, network.rotation[0, 0], up, "cameras' mean upward direction", (warning,))


def datum_from_floor(network: Network, frames: tuple[int, ...], up: str, height: float = 0.0) -> Datum:
    """Take the plane of bars laid on the floor.

    Parameters
    ----------
    network : Network
    frames : tuple of int
        Frames in which the bar lies on the floor, in two directions or places at least.
    up : {"x", "y", "z"}
    height : float
        Of the target centres above the floor, metres (the balls' radius).

    Raises
    ------
    CalibrationError
        If fewer than two of the bars were found, or they lie on one line, or far from any plane.
    """
    chosen = np.isin(network.frames, frames)
    if chosen.sum() < 2:
        raise CalibrationError(
            f"floor: of the frames {', '.join(map(str, frames))} only {int(chosen.sum())} "
            "have a bar seen by two cameras; two different places are needed"
        )
    ends = network.bars[chosen].reshape(-1, 3)
    center = ends.mean(axis=0)
    _, s, Vt = np.linalg.svd(ends - center, full_matrices=False)
    if s[1] < 0.05 * s[0]:
        raise CalibrationError("floor: the bars all lie on one line; lay the bar down in two directions")
    off = np.abs((ends - center) @ Vt[2])
    normal = Vt[2] * float(np.sign(Vt[2] @ _above(network, center)))
    warnings: tuple[str, ...] = ()
    if off.max() > max(0.02 * s[0] / np.sqrt(len(ends)), 0.01):
        worst = network.frames[chosen][off.reshape(-1, 2).max(axis=1).argmax()]
        warnings = (
            f"floor: bar ends are up to {off.max() * 1000:.0f} mm off their plane (frame {worst}); "
            "was the bar lying on the floor there?",
        )
    first = network.bars[chosen][0]
    return datum_from_axes(
        normal, center - normal * height, first[1] - first[0], up, f"{int(chosen.sum())} bars on the floor", warnings
    )


def _above(network: Network, point: np.ndarray) -> np.ndarray:
    """Direction from a point towards the cameras' centres, which are above the floor."""
    centers = -np.einsum("vji,vj->vi", network.rotation, network.translation)
    return (centers - point).mean(axis=0) + 1e-3 * rough_up(network)


def datum_from_gravity(network: Network, camera: str, gravity: np.ndarray, up: str) -> Datum:
    """Take the direction of gravity that one camera knows (an accelerometer, a spirit level).

    Parameters
    ----------
    camera : str
    gravity : (3,) float
        Downwards, in that camera's axes (x right, y down, z forward): (0, 1, 0) for a level camera.
    """
    if camera not in network.names:
        raise CalibrationError(f"gravity: no camera {camera}; there are {', '.join(network.names)}")
    gravity = np.asarray(gravity, dtype=np.float64)
    if gravity.shape != (3,) or not np.isfinite(gravity).all() or np.linalg.norm(gravity) < 1e-9:
        raise CalibrationError(f"gravity: expected three numbers, not all zero, got {gravity}")
    view = int(np.flatnonzero(network.view_camera == network.names.index(camera))[-1])
    u = -network.rotation[view].T @ gravity
    u /= np.linalg.norm(u)
    ends = network.bars.reshape(-1, 3)
    middle = ends.mean(axis=0)
    origin = middle + u * float(((ends - middle) @ u).min())
    warning = "gravity gives no floor: the lowest bar end was taken as floor height"
    return datum_from_axes(u, origin, network.rotation[0, 0], up, f"gravity of camera {camera}", (warning,))


def rigid_alignment(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation and translation that bring points (N, 3) onto others, and the scale that would fit best beside them.

    Returns
    -------
    rotation : (3, 3) float
    translation : (3,) float
    scale : float
        Not applied: 1 if both are metric (Umeyama 1991).
    """
    R, t = rigid_motion(source, target)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    return R, t, float(((a @ R.T) * b).sum() / max((a * a).sum(), 1e-30))


def datum_from_points(network: Network, pixels: np.ndarray, world: np.ndarray, what: str = "given points") -> Datum:
    """Take points whose world coordinates are known, seen by the cameras.

    Parameters
    ----------
    network : Network
    pixels : (C, N, 2) float
        COLMAP pixels, NaN where a camera does not see a point.
    world : (N, 3) float
        Metres.
    what : str
        How to call them in messages.

    Raises
    ------
    CalibrationError
        If fewer than three of them are seen by two cameras, they lie on a line, or contradict the bar's length.
    """
    points = intersect(network, pixels)
    seen = np.isfinite(points).all(axis=1)
    if seen.sum() < 3:
        raise CalibrationError(
            f"{what}: only {int(seen.sum())} of {len(world)} are seen by two cameras; three are needed"
        )
    a, b = points[seen], np.asarray(world, dtype=np.float64)[seen]
    s = np.linalg.svd(b - b.mean(axis=0), compute_uv=False)
    if s[1] < 1e-3 * s[0]:
        raise CalibrationError(f"{what}: the points lie on one line; take some beside it")
    R, t, scale = rigid_alignment(a, b)
    if abs(scale - 1) > 0.05:
        raise CalibrationError(
            f"{what}: their distances are {1 / scale:.4g} times those that the bar gives; "
            f"{'millimetres instead of metres?' if 500 < max(scale, 1 / scale) < 2000 else 'check both lengths'}"
        )
    off = np.linalg.norm(a @ R.T + t - b, axis=1)
    warnings: tuple[str, ...] = ()
    if off.max() > 0.01:
        warnings = (f"{what}: up to {off.max() * 1000:.1f} mm from where they are said to be (scale {scale:.4f})",)
    return Datum(R, t, f"{int(seen.sum())} {what}", warnings)


def intersect(network: Network, pixels: np.ndarray) -> np.ndarray:
    """Forward intersection of points (C, N, 2) seen by the network's cameras: (N, 3) float, NaN if seen by one only."""
    ideal = ideal_coordinates(pixels, network.interior, network.sizes)
    last = {int(c): v for v, c in enumerate(network.view_camera)}
    view = np.array([last.get(c, 0) for c in range(len(pixels))])
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=2)
    directions = rays @ network.rotation[view]
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    origins = -np.einsum("cji,cj->ci", network.rotation[view], network.translation[view])
    return nearest_to_rays(origins[:, None], directions)


def datum_from_l_shape(network: Network, candidates: np.ndarray, long_arm: float, short_arm: float, up: str) -> Datum:
    """Take an L-shaped reference of three targets: the corner is the origin, the long arm one axis, the short the next.

    Parameters
    ----------
    network : Network
    candidates : (C, 3, 2) float
        The three targets in each camera's image, in any order, COLMAP pixels, NaN where missing.
    long_arm, short_arm : float
        Distances of the corner's target from the other two, metres.

    Raises
    ------
    CalibrationError
        If no assignment of the targets gives these distances.
    """
    cameras = np.flatnonzero(np.isfinite(candidates).all(axis=(1, 2)))
    if len(cameras) < 2:
        raise CalibrationError("L-shape: fewer than two cameras see its three targets")
    wanted = np.array([long_arm, short_arm])
    best: tuple[float, np.ndarray] | None = None
    for first in permutations(range(3)):
        pixels = np.full((len(candidates), 3, 2), np.nan)
        pixels[cameras[0]] = candidates[cameras[0]][list(first)]
        for c in cameras[1:]:
            trials = []
            for order in permutations(range(3)):
                pixels[c] = candidates[c][list(order)]
                pair = np.full_like(pixels, np.nan)
                pair[[cameras[0], c]] = pixels[[cameras[0], c]]
                X = intersect(network, pair)
                arms = np.linalg.norm(X[1:] - X[0], axis=1)
                trials.append((float(np.abs(arms - wanted).sum()), order))
            pixels[c] = candidates[c][list(min(trials)[1])]
        X = intersect(network, pixels)
        error = float(np.abs(np.linalg.norm(X[1:] - X[0], axis=1) - wanted).max())
        if best is None or error < best[0]:
            best = (error, X)
    error, X = best if best is not None else (np.inf, np.zeros((3, 3)))
    if not error < 0.03 * long_arm:
        raise CalibrationError(
            f"L-shape: no assignment of its targets gives arms of {long_arm} and {short_arm} m "
            f"(off by {error * 1000:.0f} mm)"
        )
    long_axis, short_axis = X[1] - X[0], X[2] - X[0]
    normal = np.cross(long_axis, short_axis)
    datum = datum_from_axes(normal, X[0], long_axis, up, "an L-shaped reference")
    if normal @ _above(network, X[0]) < 0:
        datum = Datum(
            datum.rotation,
            datum.translation,
            datum.source,
            ("L-shape: the world's up points away from the cameras; are the arms mixed up, or is it upside down?",),
        )
    return datum


def datum_from_rig(network: Network, rig: Rig) -> Datum:
    """Align with an existing calibration by the centres and directions of the cameras that both have.

    Raises
    ------
    CalibrationError
        If they share fewer than two cameras, or the existing one is mirrored or far from metric.
    """
    shared = [n for n in network.names if n in rig.names]
    if len(shared) < 2:
        raise CalibrationError("alignment: fewer than two cameras have the names of the existing calibration")
    mine, other = network.rig().select(shared), rig.select(shared)
    spread = np.linalg.norm(mine.centers - mine.centers.mean(axis=0), axis=1).mean()

    def frame_points(r: Rig, reach: float) -> np.ndarray:
        # Centres with points ahead of them, so that two cameras, or cameras on a line, are enough
        R = r.cam_from_world[:, :, :3]
        return np.concatenate([r.centers, r.centers + reach * R[:, 2], r.centers + 0.5 * reach * R[:, 1]])

    _, _, scale = rigid_alignment(mine.centers, other.centers)
    R, t, _ = rigid_alignment(frame_points(mine, spread), frame_points(other, spread * scale))
    warnings: tuple[str, ...] = ()
    if abs(scale - 1) > 0.02:
        unit = (
            " (it is in millimetres)" if 900 < scale < 1100 else " (it is in centimetres)" if 90 < scale < 110 else ""
        )
        warnings = (
            f"alignment: the existing calibration is {scale:.4g} times as large as the bar says{unit}; "
            "its scale was not taken",
        )
        t = other.centers.mean(axis=0) / (scale if unit else 1.0) - R @ mine.centers.mean(axis=0)
    off = np.linalg.norm(mine.centers @ R.T + t - other.centers / (scale if abs(scale - 1) > 0.02 else 1.0), axis=1)
    if off.max() > 0.1 * spread and abs(scale - 1) <= 0.02:
        worst = shared[int(off.argmax())]
        warnings += (
            f"alignment: camera {worst} is {off.max() * 1000:.0f} mm from where the existing calibration has it",
        )
    return Datum(R, t, f"alignment to an existing calibration of {len(shared)} cameras", warnings)


def interiors_of(rig: Rig) -> np.ndarray:
    """Interior parameters of a rig's cameras, (C, 13) float."""
    return np.array([interior_of(camera) for camera in rig.cameras])
