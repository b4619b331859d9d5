"""Template groups: which camera is matched with which others, from the cameras' geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from geomocap.dense.dense_settings import GroupSettings
from geomocap.dense.search_bounds import Box
from geomocap.errors import CalibrationError
from geomocap.matching.epipolar import transfers
from geomocap.model.rig import Rig

_PARALLEL = math.sin(math.radians(2.0)) ** 2  # axes that differ less from their mean don't meet in a scene
_ANYWHERE = (0.15, 6.0)  # bounds of the depth where axes don't meet, in distances of the scene


@dataclass(frozen=True)
class MatchGroup:
    """A template camera and its search cameras.

    Attributes
    ----------
    template : int
    searches : (K,) int
    transfers : (K, 12) float
        Their epipolar geometry (`matching.epipolar`).
    depth : float
        Of the scene's middle, metres.
    near, far : float
        Depths between which the scene lies, metres.
    """

    template: int
    searches: np.ndarray
    transfers: np.ndarray
    depth: float
    near: float
    far: float

    def select(self, which: np.ndarray) -> MatchGroup:
        """Return the group with the search cameras `which`, (K,) bool, alone."""
        return replace(self, searches=self.searches[which], transfers=self.transfers[which])


@dataclass(frozen=True)
class MatchGroups:
    """All that is computed once for a capture.

    Attributes
    ----------
    rig : Rig
        The pinhole cameras in whose images is matched (`Rig.undistorted`).
    maps : tuple of (map_x, map_y) or None
        Where their pixels come from; None for cameras without distortion.
    groups : tuple of MatchGroup
    spare : tuple of MatchGroup
        To fall back on where one template alone is used and shows nothing.
    """

    rig: Rig
    maps: tuple[tuple[np.ndarray, np.ndarray] | None, ...]
    groups: tuple[MatchGroup, ...]
    spare: tuple[MatchGroup, ...] = ()


def scene_center(rig: Rig) -> tuple[np.ndarray, bool]:
    """Point nearest to all optical axes, (3,) float, metres, world, and whether they really meet there.

    Axes that are all but parallel, or part, leave it open: then it is put before the cameras, at eight times the
    distance between them.
    """
    d = rig.viewing_directions
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] > len(rig) * _PARALLEL:
        center = np.linalg.solve(total, (across @ rig.centers[:, :, None]).sum(axis=0)[:, 0])
        if (np.einsum("ci,ci->c", center - rig.centers, d) > 0).all():
            return center, True
    middle, forward = rig.centers.mean(axis=0), d.mean(axis=0)
    base = max(float(np.linalg.norm(a - b)) for a in rig.centers for b in rig.centers)
    return middle + 8 * base * forward / max(float(np.linalg.norm(forward)), 1e-12), False


def match_groups(rig: Rig, settings: GroupSettings | None = None, box: Box | None = None) -> MatchGroups:
    """Choose templates and their search cameras.

    A template is matched with cameras whose directions to the middle of the scene differ enough for precision and
    little enough for likeness; the second lies, where it can, on another side than the first.

    Parameters
    ----------
    rig : Rig
        At least two cameras.
    settings : GroupSettings, optional
    box : Box, optional
        Region of interest; its middle is that of the scene then.

    Raises
    ------
    CalibrationError
        If no camera has a neighbour within the angles allowed.
    """
    settings = settings or GroupSettings()
    pinhole = rig.undistorted()
    center, meet = _middle(rig, box)
    near, far = (settings.near, settings.far) if meet else _ANYWHERE
    angles = _angles(rig, center)
    groups = []
    templates, spare = _templates(rig, angles, settings)
    for t in templates + spare:
        searches = _searches(rig, t, angles, settings)
        if len(searches):
            T = transfers(pinhole, t, searches.tolist())
            depth = float((center - rig.centers[t]) @ rig.viewing_directions[t])
            groups.append(MatchGroup(t, searches, T, depth, near * depth, far * depth))
    if not groups:
        raise CalibrationError(_unmatched(angles[np.triu_indices(len(rig), 1)], settings))
    maps = tuple(None if c.is_undistorted() else rig.undistortion_map(i) for i, c in enumerate(rig.cameras))
    count = max(sum(g.template in templates for g in groups), 1)
    return MatchGroups(pinhole, maps, tuple(groups[:count]), tuple(groups[count:]))


def _unmatched(angles: np.ndarray, settings: GroupSettings) -> str:
    """Say that no two cameras can be matched, and which setting keeps them from it."""
    low, high = angles.min(initial=180), angles.max(initial=0)
    span = f"{low:.0f}°" if len(angles) < 2 else f"{low:.0f}° to {high:.0f}°"
    if high < settings.least_angle:
        mend = "reduce cloud.groups.least_angle or place cameras further apart"
    else:
        mend = "enlarge cloud.groups.greatest_angle or add cameras between"
    return (
        f"no two cameras can be matched: their viewing directions differ by {span}, expected "
        f"{settings.least_angle:g}° to {settings.greatest_angle:g}°; {mend}"
    )


def too_far_apart(rig: Rig, settings: GroupSettings, box: Box | None = None) -> bool:
    """Whether the directions of any two cameras to the middle of the scene differ too much for them to be matched."""
    angles = _angles(rig, _middle(rig, box)[0])[np.triu_indices(len(rig), 1)]
    return bool((angles > settings.greatest_angle).all())


def _middle(rig: Rig, box: Box | None) -> tuple[np.ndarray, bool]:
    """Middle of the scene, and whether it is known, see `scene_center`."""
    return scene_center(rig) if box is None else (np.mean(box, axis=0), True)


def _angles(rig: Rig, center: np.ndarray) -> np.ndarray:
    """Angles between the cameras' directions to a point, (C, C) float, degrees."""
    rays = center - rig.centers
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)))


def _templates(rig: Rig, angles: np.ndarray, settings: GroupSettings) -> tuple[list[int], list[int]]:
    """Choose the templates, and those to fall back on."""
    if settings.template_camera is not None and settings.template_camera not in rig.names:
        raise CalibrationError(f"template camera {settings.template_camera}: the rig has {', '.join(rig.names)}")
    if settings.templates == "all" or (settings.templates == "auto" and len(rig) > 3):
        return list(range(len(rig))), []
    if settings.template_camera is not None:
        return [rig.names.index(settings.template_camera)], []
    central, *others = np.argsort(angles.max(axis=1), kind="stable").tolist()
    return [central], others if settings.templates == "auto" else []


def _searches(rig: Rig, template: int, angles: np.ndarray, settings: GroupSettings) -> np.ndarray:
    """Choose search cameras of one template, best first."""
    angle = angles[template]
    possible = [
        i for i in range(len(rig)) if i != template and settings.least_angle <= angle[i] <= settings.greatest_angle
    ]
    # Directions in which the other cameras lie, seen from the template
    side = (rig.centers - rig.centers[template]) @ rig.cam_from_world[template, :2, :3].T
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    chosen: list[int] = []
    while possible and len(chosen) < settings.searches:
        # On another side than those chosen, and near the angle aimed at
        crowded = [max((float(side[i] @ side[j]) for j in chosen), default=-1.0) for i in possible]
        cost = [
            abs(np.log(angle[i] / settings.best_angle)) + max(c, 0.0) for i, c in zip(possible, crowded, strict=True)
        ]
        best = possible[int(np.argmin(cost))]
        chosen.append(best)
        possible.remove(best)
    return np.array(chosen, dtype=np.int64)
