"""A rig: named, calibrated, static cameras, as pycolmap cameras and world-to-camera poses.

Pixels are COLMAP's everywhere: the centre of the top-left pixel is (0.5, 0.5). An array index is a coordinate
minus 0.5.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap
from geomocap.model.orientations import EXACT, NOTED, check_camera, nearest_rotation
from geomocap.reading import check_name

FARTHEST = 1e7  # metres of a translation; beyond, single numbers of the surface get lost


@dataclass(frozen=True)
class Rig:
    """Named cameras with their poses.

    Attributes
    ----------
    names : tuple of C str
        Camera names, as the folders of the capture.
    cameras : tuple of C pycolmap.Camera
        Interior orientations (any COLMAP model), pixels.
    cam_from_world : (C, 3, 4) float
        Exterior orientations [R | t], metres: x_cam = R x_world + t; x right, y down, z forward. A rotation of few
        digits is made orthonormal.
    notes : tuple of str
        What a user should know of it.

    Raises
    ------
    CalibrationError
        If names, interior or exterior orientations can't be those of cameras.
    """

    names: tuple[str, ...]
    cameras: tuple[pycolmap.Camera, ...]
    cam_from_world: np.ndarray
    notes: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        pose = np.ascontiguousarray(self.cam_from_world, dtype=np.float64)
        if len(set(self.names)) != len(self.names):
            raise CalibrationError(f"camera names must be unique, got {', '.join(self.names)}")
        if len(self.cameras) != len(self.names) or pose.shape != (len(self.names), 3, 4):
            raise CalibrationError(
                f"{len(self.names)} camera names, {len(self.cameras)} cameras and poses of shape {pose.shape}: "
                "expected one camera and one 3×4 pose a name"
            )
        pose, notes = np.array(pose), list(self.notes)
        for name, camera, row in zip(self.names, self.cameras, pose, strict=True):
            check_name(name, "calibration", CalibrationError)
            where = f"camera {name}"
            check_camera(camera, where)
            R, off = nearest_rotation(row[:, :3], where)
            if off > EXACT:
                row[:, :3] = R
            if off > NOTED:
                notes.append(f"{where}: its rotation is orthonormal to {off:.1g} only; the nearest rotation is taken")
            if not np.abs(row[:, 3]).max() <= FARTHEST:
                raise CalibrationError(
                    f"{where}: its translation ({', '.join(f'{v:.3g}' for v in row[:, 3])}) can't be metres"
                )
        pose.flags.writeable = False
        object.__setattr__(self, "cam_from_world", pose)
        object.__setattr__(self, "notes", tuple(dict.fromkeys(notes)))

    @classmethod
    def of_file(
        cls,
        where: str,
        names: Iterable[str],
        cameras: Iterable[pycolmap.Camera],
        poses: np.ndarray,
        notes: Iterable[str] = (),
    ) -> Rig:
        """Make a rig of what a file says; errors begin with `where`."""
        try:
            return cls(tuple(names), tuple(cameras), poses, tuple(notes))
        except CalibrationError as error:
            raise CalibrationError(f"{where}: {error}") from None

    def __len__(self) -> int:
        return len(self.names)

    def __getstate__(self) -> dict:
        return {
            "names": self.names,
            "cameras": [camera.todict() for camera in self.cameras],
            "cam_from_world": np.array(self.cam_from_world),
            "notes": self.notes,
        }

    def __setstate__(self, state: dict) -> None:
        cameras = tuple(pycolmap.Camera(c) for c in state["cameras"])
        object.__setattr__(self, "names", state["names"])
        object.__setattr__(self, "cameras", cameras)
        object.__setattr__(self, "cam_from_world", state["cam_from_world"])
        object.__setattr__(self, "notes", state["notes"])

    def select(self, names: Iterable[str]) -> Rig:
        """Return the rig of these cameras only, in this order."""
        index = [self.names.index(n) for n in names]
        return Rig(
            tuple(self.names[i] for i in index),
            tuple(self.cameras[i] for i in index),
            self.cam_from_world[index],
            self.notes,
        )

    @property
    def centers(self) -> np.ndarray:
        """Projection centres, (C, 3) float, metres, world."""
        R, t = self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]
        return -np.einsum("cji,cj->ci", R, t)

    @property
    def sizes(self) -> np.ndarray:
        """Image sizes, (C, 2) int: width, height in pixels."""
        return np.array([(c.width, c.height) for c in self.cameras], dtype=np.int64).reshape(-1, 2)

    @property
    def viewing_directions(self) -> np.ndarray:
        """Unit viewing directions, (C, 3) float, world."""
        return np.array(self.cam_from_world[:, 2, :3])

    @property
    def is_pinhole(self) -> bool:
        """Whether no camera has distortion, so that `projections` describes it fully."""
        return all(c.is_undistorted() for c in self.cameras)

    @property
    def projections(self) -> np.ndarray:
        """Projection matrices K [R | t] without distortion, (C, 3, 4) float, world metres to COLMAP pixels."""
        K = np.array([c.calibration_matrix() for c in self.cameras])
        return K @ self.cam_from_world

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """Transform points (N, 3), metres, world, into all cameras: (C, N, 3) float."""
        R, t = self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]
        return np.einsum("cij,nj->cni", R, points) + t[:, None]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points (N, 3), metres, world, into all cameras, distortion included.

        Returns
        -------
        pixels : (C, N, 2) float
            COLMAP pixels; NaN for points behind a camera. Points outside the image are not cut off.
        """
        in_camera = self.to_camera(np.asarray(points, dtype=np.float64))
        pixels = np.full((*in_camera.shape[:2], 2), np.nan)
        for c, camera in enumerate(self.cameras):
            front = in_camera[c, :, 2] > 1e-9
            if front.any():
                pixels[c, front] = camera.img_from_cam(in_camera[c, front])
        return pixels

    def rays(self, camera: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cast viewing rays through pixels (N, 2) of one camera, distortion removed.

        Returns
        -------
        origin : (3,) float, metres, world
        directions : (N, 3) float, world, unit length
        """
        normalized = np.asarray(
            self.cameras[camera].cam_from_img(np.asarray(pixels, dtype=np.float64)), dtype=np.float64
        )
        in_camera = np.column_stack([normalized, np.ones(len(normalized))])
        in_camera /= np.linalg.norm(in_camera, axis=1, keepdims=True)
        return self.centers[camera], in_camera @ self.cam_from_world[camera, :, :3]

    def reduced(self, longest: int) -> Rig:
        """Return the rig with images reduced by whole factors, their longer sides to about `longest` pixels."""
        cameras = []
        for camera in self.cameras:
            factor = reduction(camera.width, camera.height, longest)
            small = pycolmap.Camera(camera.todict())
            small.rescale(camera.width // factor, camera.height // factor)
            cameras.append(small)
        return Rig(self.names, tuple(cameras), np.array(self.cam_from_world))

    def shrunk(self, factor: int) -> Rig:
        """Return the rig with images reduced by a whole factor; sizes that it doesn't divide are rounded up."""
        cameras = []
        for camera in self.cameras:
            small = pycolmap.Camera(camera.todict())
            small.rescale(-(-camera.width // factor), -(-camera.height // factor))
            cameras.append(small)
        return Rig(self.names, tuple(cameras), np.array(self.cam_from_world))

    def undistorted(self) -> Rig:
        """Return the rig of pinhole cameras that see at least all that the real cameras see.

        Same poses and camera constants; size and principal point are moved so that every original pixel falls
        inside (bounded to four times the original area against runaway polynomials). `undistortion_maps` says where
        the pixels come from.
        """
        cameras = []
        for camera in self.cameras:
            w, h = camera.width, camera.height
            fx, fy = camera.focal_length_x, camera.focal_length_y
            if camera.is_undistorted():
                K = camera.calibration_matrix()
                params = [fx, fy, K[0, 2], K[1, 2]]
                cameras.append(pycolmap.Camera(model="PINHOLE", width=w, height=h, params=params))
                continue
            u, v = np.linspace(0, w, 65), np.linspace(0, h, 65)
            border = np.concatenate(
                [
                    np.column_stack([u, np.zeros(65)]),
                    np.column_stack([u, np.full(65, h)]),
                    np.column_stack([np.zeros(65), v]),
                    np.column_stack([np.full(65, w), v]),
                ]
            )
            n = np.asarray(camera.cam_from_img(border), dtype=np.float64) * [fx, fy]
            center = np.array([camera.principal_point_x, camera.principal_point_y])
            low = np.maximum(np.nanmin(n + center, axis=0), [-w / 2, -h / 2])
            high = np.minimum(np.nanmax(n + center, axis=0), [1.5 * w, 1.5 * h])
            low, high = np.floor(np.minimum(low, 0)), np.ceil(np.maximum(high, [w, h]))
            size = (high - low).astype(int)
            params = [fx, fy, *(center - low)]
            cameras.append(pycolmap.Camera(model="PINHOLE", width=int(size[0]), height=int(size[1]), params=params))
        return Rig(self.names, tuple(cameras), np.array(self.cam_from_world), self.notes)

    def undistortion_map(self, camera: int) -> tuple[np.ndarray, np.ndarray]:
        """Say where each pixel of the undistorted image comes from, as `cv2.remap` wants it.

        Returns
        -------
        map_x, map_y : (H', W') float32
            Array indices (coordinate minus 0.5) into the original image, H' × W' the size of `undistorted()`.
        """
        target = self.undistorted().cameras[camera]
        x, y = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
        normalized = np.asarray(target.cam_from_img(np.column_stack([x.ravel(), y.ravel()])))
        source = self.cameras[camera].img_from_cam(np.column_stack([normalized, np.ones(len(normalized))]))
        source = np.nan_to_num(source.astype(np.float32) - np.float32(0.5), nan=-1e6)
        return source[:, 0].reshape(x.shape), source[:, 1].reshape(x.shape)


def reduction(width: int, height: int, longest: int) -> int:
    """Return by how much an image is reduced, so that its longer side is about `longest` pixels."""
    return max(1, round(max(width, height) / longest))
