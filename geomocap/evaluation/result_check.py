"""How good a result is, without any truth: does it explain what every camera saw?

Three questions, each asked of what the others did not use for their answer:

- *Model.* The skinned model, posed by the motion found, is drawn into the cameras. Its outline is compared with the
  silhouettes (intersection over union). Wrong bodies, joints or turns put limbs where no silhouette is.
- *Cameras.* Each camera in turn is left out; the visual hull of the others is drawn into it. Calibration,
  synchronization and silhouettes that fit together give nearly the silhouette; a camera that contradicts the others
  stands out. (The hull is always a little larger than the subject, the more so the fewer cameras there are.)
- *Paths.* How far tracked surface points stay from where their bodies carry them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.hull import hull
from geomocap.carving.silhouette_views import PinholeViews, Undistortion
from geomocap.carving.visibility import SurfaceVoxels, depth_buffers
from geomocap.carving.voxel_grid import Grid
from geomocap.files.capture import Capture
from geomocap.files.corrected_cameras import as_seen
from geomocap.files.results import read_diagnostics, read_silhouette, read_skeleton
from geomocap.files.run import Run
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.ray_casting import TriangleScene
from geomocap.model.rig import Rig
from geomocap.model.self_check import SelfCheck
from geomocap.scheduling import map_here
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.subject.model_mesh import DRAWN_TRIANGLES, ModelMesh, model_mesh
from geomocap.subject.subject_model import MODEL_FILE, SubjectModel, read_model
from geomocap.subject.window_motion import motion_of

FRAMES = 6  # evenly spread
LONGEST_SIDE = 320  # pixels in which outlines are compared
# Along the longest side of the hull that is drawn into a camera left out. With 96, 192, 256 and 384 a man whom
# eight cameras see well overlapped by 0.862, 0.885, 0.891 and 0.896: cells at the border stick out.
CELLS = 256
_AROUND = 0.15  # by which the volume of the left-out hull is larger than the subject
_ALL_FACES = 63


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
        model[:, column] = _drawn_overlaps(mesh, motion, seen, outlines.rig, frame)
        left_out[:, column] = _left_out_overlaps(seen, _placed(mesh, motion, frame))
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


def _left_out_overlaps(views: PinholeViews, subject: np.ndarray) -> np.ndarray:
    """Overlap of each camera's silhouette with the hull of all other cameras, (C,) float."""
    result = np.full(len(views), np.nan)
    low, high = subject.min(axis=0), subject.max(axis=0)
    margin = _AROUND * float((high - low).max())
    grid = Grid.of_box(low - margin, high + margin, resolution=CELLS)
    blind = views.blind()
    for c in range(len(views)) if len(views) > 2 else ():
        if blind[c]:
            continue
        surface = hull(views.without(c), grid, HullSettings()).surface_indices()
        one = PinholeViews(
            views.names[c : c + 1], views.projections[c : c + 1], views.masks[c : c + 1], views.valid[c : c + 1]
        )
        faces = np.full(len(surface), _ALL_FACES, np.uint8)
        drawn = np.isfinite(depth_buffers(one, grid, SurfaceVoxels(surface.astype(np.int32), faces))[0])
        result[c] = _overlap(drawn & (one.valid[0] > 0), one.masks[0] > 0)
    return result


def _shrunk(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize((mask > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    either = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / either if either else float("nan")
