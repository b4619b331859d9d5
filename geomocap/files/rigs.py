"""Rigs as COLMAP models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from geomocap.errors import CalibrationError
from geomocap.files.atomic import write_folder
from geomocap.files.colmap_model import read_colmap_model
from geomocap.model.colmap_library import pycolmap
from geomocap.model.orientations import NOTED
from geomocap.model.rig import Rig
from geomocap.reading import check_name

MODEL_FILES = frozenset(
    f"{name}.{ending}" for name in ("cameras", "frames", "images", "points3D", "rigs") for ending in ("bin", "txt")
)


def read_rig(sparse: Path, names: Sequence[str] | None = None) -> Rig:
    """Read a COLMAP model whose image names begin with the camera's name (`<camera>/<anything>`).

    Parameters
    ----------
    sparse : Path
        Folder of a COLMAP model, text or binary.
    names : sequence of str, optional
        The cameras wanted, in this order; all of them, sorted by name, if not given.

    Raises
    ------
    CalibrationError
        If the folder holds no model, or a camera has no posed image, or two images disagree about its pose.
    """
    model = read_colmap_model(sparse)
    found: dict[str, tuple[pycolmap.Camera, np.ndarray]] = {}
    notes: dict[str, str] = {}
    for image in sorted(model.images, key=lambda i: i.name):
        name = image.name.split("/")[0] if "/" in image.name else Path(image.name).stem
        check_name(name, str(sparse), CalibrationError)
        pose = image.pose
        if image.camera not in model.cameras:
            raise CalibrationError(f"{sparse}: image {image.name} is of camera {image.camera}, which isn't there")
        if name in found and not np.allclose(found[name][1], pose, atol=1e-9):
            raise CalibrationError(
                f"{sparse}: images of camera {name} have different poses, but cameras must not move; "
                f"keep one image {name}/<anything>"
            )
        if image.off > NOTED:
            notes[name] = f"camera {name}: its quaternion is of unit length to {image.off:.1g} only; it is taken as one"
        found.setdefault(name, (model.cameras[image.camera], pose))
    wanted = tuple(sorted(found)) if names is None else tuple(names)
    for name in wanted:
        if name not in found:
            raise CalibrationError(
                f"{sparse}: no posed image of camera {name}; the model has {', '.join(sorted(found)) or 'none'}"
            )
    cameras, poses = [found[n][0] for n in wanted], [found[n][1] for n in wanted]
    return Rig.of_file(str(sparse), wanted, cameras, np.array(poses).reshape(-1, 3, 4), notes.values())


def colmap_model(rig: Rig) -> pycolmap.Reconstruction:
    """Return a rig as a COLMAP model with one image `<camera>/000000.png` a camera and no points."""
    model = pycolmap.Reconstruction()
    for i, (name, camera, pose) in enumerate(zip(rig.names, rig.cameras, rig.cam_from_world, strict=True)):
        copy = pycolmap.Camera(camera.todict())
        copy.camera_id = i + 1
        model.add_camera_with_trivial_rig(copy)
        image = pycolmap.Image(name=f"{name}/000000.png", camera_id=i + 1, image_id=i + 1)
        rotation = pycolmap.Rotation3d(np.array(pose[:, :3]))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, np.array(pose[:, 3])))
    return model


def write_rig(sparse: Path, rig: Rig, *, binary: bool = False) -> None:
    """Write a rig as a COLMAP model into the folder `sparse`, made if need be; see `write_model`."""
    write_model(sparse, colmap_model(rig), binary=binary)


def write_model(
    sparse: Path, model: pycolmap.Reconstruction, *, binary: bool = False, beside: Mapping[str, str] | None = None
) -> None:
    """Put a COLMAP model in the place of the one in a folder, whole or not at all; other files there stay.

    Parameters
    ----------
    sparse : Path
    model : pycolmap.Reconstruction
    binary : bool
    beside : mapping of str to str, optional
        Further files, name and text.

    Raises
    ------
    RunError
        If the folder can't be written.
    """
    texts = beside or {}

    def write(folder: Path) -> None:
        (model.write_binary if binary else model.write_text)(str(folder))
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")

    def whole(folder: Path) -> bool:
        if not binary and not all(f.read_bytes().endswith(b"\n") for f in folder.glob("*.txt")):
            return False
        try:
            back = pycolmap.Reconstruction(str(folder))
        except Exception:
            return False
        counts = [(m.num_cameras(), m.num_images(), m.num_points3D()) for m in (model, back)]
        return counts[0] == counts[1]

    write_folder(sparse, write, whole, MODEL_FILES)
