"""How good a result is, without any truth: does it explain what every camera saw?

Three questions, each asked of what the others did not use for their answer:

- *Model.* The skinned model, posed by the motion found, is drawn into the cameras. Its outline is compared with the
  silhouettes (intersection over union). Wrong bodies, joints or turns put limbs where no silhouette is.
- *Cameras.* Each camera in turn is left out; the visual hull of the others is drawn into it, ray by ray. Calibration,
  synchronization and silhouettes that fit together give nearly the silhouette; a camera that contradicts the others
  stands out. (The hull is always a little larger than the subject, the more so the fewer cameras there are.)
  A piece beside a silhouette's largest that the others don't confirm together, a cable or a reflection, isn't compared
  with it; a camera that lacks a limb and so denies it to the others still stands out by itself. With the model it is.
- *Paths.* How far tracked surface points stay from where their bodies carry them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.hull import heard
from geomocap.carving.silhouette_views import PinholeViews, Undistortion
from geomocap.carving.visibility import camera_centers
from geomocap.files.capture import Capture
from geomocap.files.corrected_cameras import as_seen
from geomocap.files.results import read_diagnostics, read_silhouette, read_skeleton
from geomocap.files.run import Run
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.ray_casting import TriangleScene
from geomocap.model.rig import Rig
from geomocap.model.self_check import SelfCheck
from geomocap.scheduling import map_here
from geomocap.silhouettes.ray_agreement import denied_rays
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.subject.model_mesh import DRAWN_TRIANGLES, ModelMesh, model_mesh
from geomocap.subject.subject_model import MODEL_FILE, SubjectModel, read_model
from geomocap.subject.window_motion import motion_of

FRAMES = 6  # evenly spread
LONGEST_SIDE = 320  # pixels in which outlines are compared
SAMPLED = 160  # pixels along the longest side at which hulls are drawn, about; 160 and 320 differ by 0.001
_AROUND = 0.15  # of the longest side of the subject's box: so far around it the others' hull is looked for


def check_run(run: Run, capture: Capture) -> SelfCheck | None:
    """Compare a run's motion with its silhouettes; None if it has no model, skeleton or silhouettes.

    Parameters
    ----------
    run : Run
    capture : Capture
        What it was made from.
    """
    needed = (MODEL_FILE, "skeleton.npz", "silhouettes")
    if not capture.is_calibrated or not all((run.path / name).exists() for name in needed):
        return None
    skeleton, mesh = read_skeleton(run), checked_mesh(read_model(run.path / MODEL_FILE))
    motion = motion_of(skeleton)
    residual = float("nan")
    if (run.path / "diagnostics.npz").exists():
        found = read_diagnostics(run).sample_residuals
        if found is not None and len(found):
            residual = float(np.median(found)) / float(np.linalg.norm(np.ptp(mesh.surface.vertices, axis=0)))
    seen = SeenOutlines.of(run, capture)
    return check_result(capture.cameras, _looks(range(len(motion.rotations))), seen, mesh, motion, residual)


def checked_mesh(model: SubjectModel) -> ModelMesh:
    """Return a model's surface as it is compared with silhouettes."""
    return model_mesh(model, DRAWN_TRIANGLES)


@dataclass(frozen=True)
class SeenOutlines:
    """What the cameras of a run saw of its subject.

    Attributes
    ----------
    views : callable
        `views(frame)`: undistorted silhouettes of all cameras.
    rig : Rig
        Undistorted cameras of these.
    """

    views: Callable[[int], PinholeViews]
    rig: Rig

    @classmethod
    def of(cls, run: Run, capture: Capture) -> SeenOutlines:
        """Return those of a run, by the cameras that it used."""
        capture = as_seen(run, capture)
        undistortion = Undistortion.of(capture.rig)
        return cls(
            lambda frame: undistortion.views([read_silhouette(run, camera, frame) for camera in capture.cameras]),
            capture.rig.undistorted(),
        )


def model_overlap(seen: SeenOutlines, mesh: ModelMesh, motion: BodyMotion, frames: range | None = None) -> float:
    """Overlap of a model, drawn in a motion from its pose, with the silhouettes: the mean over their images.

    It says, without any truth, which of several results for one recording, or for some `frames` of it, explains the
    images best.
    """
    looks = _looks(range(len(motion.rotations)) if frames is None else frames)
    return float(np.nanmean(map_here(lambda k: _drawn_overlaps(mesh, motion, seen.views(k), seen.rig, k), looks)))


def _looks(frames: range) -> list[int]:
    """Return the frames that are looked at, of some."""
    return [frames[k] for k in evenly_chosen(len(frames), FRAMES)]


def check_result(
    cameras: Sequence[str],
    frames: Sequence[int],
    outlines: SeenOutlines,
    mesh: ModelMesh,
    motion: BodyMotion,
    residual: float = np.nan,
) -> SelfCheck:
    """Compare a motion with the silhouettes it was found from.

    Parameters
    ----------
    cameras : sequence of C str
    frames : sequence of F int
        Which to look at.
    outlines : SeenOutlines
    mesh : ModelMesh
        The subject's surface in the pose of frame 0.
    motion : BodyMotion
        From frame 0 on.
    residual : float
        See `SelfCheck`.
    """
    model = np.full((len(cameras), len(frames)), np.nan)
    left_out = np.full_like(model, np.nan)
    for column, frame in enumerate(frames):
        seen = outlines.views(frame)
        hulls = _hulls_of_others(seen, _placed(mesh, motion, frame))
        model[:, column] = _drawn_overlaps(mesh, motion, seen, outlines.rig, frame)
        seen = _confirmed(seen, hulls)
        for c, drawn in enumerate(hulls):
            if drawn is not None:
                left_out[c, column] = _overlap(drawn, seen.masks[c][_sampled(seen)] > 0)
    return SelfCheck(tuple(cameras), np.asarray(frames), model, left_out, float(residual))


def _placed(mesh: ModelMesh, motion: BodyMotion, frame: int) -> np.ndarray:
    """Return the model's surface in a frame, (V, 3) float, metres."""
    return motion.part(slice(frame, frame + 1)).carry(mesh.skin.rest, mesh.skin.bodies, mesh.skin.fractions)[0]


def _drawn_overlaps(mesh: ModelMesh, motion: BodyMotion, seen: PinholeViews, rig: Rig, frame: int) -> np.ndarray:
    """Overlap of the model in a frame with each camera's silhouette, (C,) float; NaN where a camera is blind."""
    scene = TriangleScene(_placed(mesh, motion, frame), mesh.surface.triangles)
    result = np.full(len(seen), np.nan)
    for c in np.flatnonzero(~seen.blind()):
        result[c] = _drawn_overlap(scene, rig, seen, int(c))
    return result


def _drawn_overlap(scene: TriangleScene, rig: Rig, views: PinholeViews, camera: int) -> float:
    """Overlap of what is drawn into a camera with its silhouette."""
    width, height = (int(n) for n in rig.sizes[camera])
    shrunk = min(1.0, LONGEST_SIDE / max(width, height))
    size = max(1, round(shrunk * width)), max(1, round(shrunk * height))
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    center, directions = rig.rays(camera, np.stack([x * width / size[0], y * height / size[1]], axis=-1).reshape(-1, 2))
    rays = np.concatenate([np.broadcast_to(center, directions.shape), directions], axis=1)
    drawn = scene.occluded(rays).reshape(x.shape)
    mask = _shrunk(views.masks[camera, :height, :width], size)
    return _overlap(drawn & _shrunk(views.valid[camera, :height, :width], size), mask)


def _hulls_of_others(views: PinholeViews, subject: np.ndarray) -> list[np.ndarray | None]:
    """Draw the hull of all other cameras into each camera, at its sampled pixels (H', W') bool; None without others.

    A pixel is drawn if a point on its ray lies in all the other silhouettes: voxels would stick out at the border.
    """
    low, high = subject.min(axis=0), subject.max(axis=0)
    margin = _AROUND * float((high - low).max())
    inverse = np.linalg.inv(views.projections[:, :, :3])
    centers = camera_centers(views.projections)
    away = np.linalg.norm(centers - 0.5 * (low + high), axis=1)
    pixel = float((away / np.linalg.norm(views.projections[:, 0, :3], axis=1)).min())  # at the subject, metres
    y, x = np.mgrid[: views.masks.shape[1], : views.masks.shape[2]][(slice(None), *_sampled(views))] + 0.5
    pixels, blind = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3), views.blind()

    def drawn(c: int) -> np.ndarray | None:
        if blind[c] or len(views) < 3:
            return None
        heeded, unseen, least = heard(views.without(c), HullSettings())
        rays = pixels @ inverse[c].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        walls = np.stack([low - margin, high + margin]) - centers[c]
        meets = walls[:, None] / np.where(np.abs(rays) < 1e-9, 1e-9, rays)
        spans = np.stack([meets.min(axis=0).max(axis=1).clip(0.0), meets.max(axis=0).min(axis=1)], axis=-1)
        others = heeded.projections, heeded.masks, heeded.valid, unseen
        result = ~denied_rays(*others, centers[c], rays, spans, pixel, 0, least)
        return result.reshape(x.shape) & (views.valid[c][_sampled(views)] > 0)

    return map_here(drawn, range(len(views)))


def _confirmed(views: PinholeViews, hulls: Sequence[np.ndarray | None]) -> PinholeViews:
    """Leave out what the hull of all other cameras doesn't meet, of each silhouette's pieces but the largest."""
    masks = views.masks.copy()
    for mask, drawn in zip(masks, hulls, strict=True):
        if drawn is not None:
            _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
            keep = np.bincount(labels[_sampled(views)][drawn], minlength=len(stats)) > 0
            keep[1 + np.argmax(stats[1:, cv2.CC_STAT_AREA])] = True
            keep[0] = False
            mask[~keep[labels]] = 0
    return PinholeViews(views.names, views.projections, masks, views.valid)


def _sampled(views: PinholeViews) -> tuple[slice, slice]:
    """Rows and columns of the pixels at which hulls are drawn."""
    step = slice(None, None, max(1, round(max(views.masks.shape[1:]) / SAMPLED)))
    return step, step


def _shrunk(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize((mask > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    either = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / either if either else float("nan")
