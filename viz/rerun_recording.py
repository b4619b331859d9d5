"""What the viewer shows, as a recording for Rerun (extra `rerun`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geomocap.export.export_errors import require
from geomocap.files.atomic import write_atomic
from geomocap.model.palette import body_color, body_colors
from viz.drawing import webp
from viz.view_content import Content

POINTS = 20_000
"""Points of a frame at most."""

PICTURE_WIDTH = 480
"""Of the cameras' pictures, pixels at most."""


def write_recording(path: Path, contents: Sequence[Content]) -> None:
    """Write contents as a Rerun recording, whole or not at all: points, skeleton, markers, cameras with pictures.

    Parameters
    ----------
    path : Path
        An .rrd file.
    contents : sequence of Content
        Each under its title.

    Raises
    ------
    MissingPackageError
        If rerun-sdk isn't installed.
    RunError
        If the file can't be written.
    """
    rr = require("rerun", extra="rerun", purpose="Rerun recordings")

    def write(target: Path) -> None:
        recording = rr.RecordingStream("geomocap")
        recording.save(target)
        for k, content in enumerate(contents):
            _record(rr, recording, f"{k}", content)
        recording.flush()
        recording.disconnect()

    write_atomic(path, write)


def _record(rr: Any, recording: Any, root: str, content: Content) -> None:
    up = {"x": rr.ViewCoordinates.RIGHT_HAND_X_UP, "y": rr.ViewCoordinates.RIGHT_HAND_Y_UP}
    recording.log(root, up.get(content.up, rr.ViewCoordinates.RIGHT_HAND_Z_UP), static=True)
    recording.log(f"{root}/title", rr.TextDocument(content.title), static=True)
    if content.rig is not None:
        for c, camera in enumerate(content.rig.cameras):
            R = content.rig.cam_from_world[c, :, :3]
            pose = rr.Transform3D(translation=content.rig.centers[c], mat3x3=R.T)
            lens = rr.Pinhole(
                image_from_camera=camera.calibration_matrix(),
                width=camera.width,
                height=camera.height,
                camera_xyz=rr.ViewCoordinates.RDF,
            )
            recording.log(f"{root}/cameras/{c}", pose, lens, static=True)
            recording.log(f"{root}/cameras/{c}/name", rr.TextDocument(content.rig.names[c]), static=True)
    for frame in range(content.n_frames):
        recording.set_time("frame", sequence=frame)
        recording.set_time("time", duration=frame / content.fps)
        surface = content.points(frame)
        if surface is not None and len(surface.points):
            shown = surface.thinned(POINTS)
            points = rr.Points3D(shown.points, colors=shown.colors, radii=0.5 * shown.spacing)
            recording.log(f"{root}/points", points)
        if content.surface is not None:
            faces, owner = content.surface.faces, content.surface.owner
            corners = content.surface.at(frame)[faces].reshape(-1, 3)
            triangles, shades = np.arange(len(corners)).reshape(-1, 3), np.repeat(body_colors(owner), 3, axis=0)
            recording.log(f"{root}/surface", rr.Mesh3D(
                vertex_positions=corners, triangle_indices=triangles, vertex_colors=shades
            ))  # fmt: skip
        if content.motion is not None:
            colors = [body_color(int(content.motion.bodies[n])) for n, _ in content.bones]
            labels = [content.motion.names[n] for n, _ in content.bones]
            bones = rr.LineStrips3D(content.bone_ends(frame), colors=colors, labels=labels, show_labels=False)
            recording.log(f"{root}/skeleton", bones)
            joints = content.posture[1][frame]
            labels = list(content.joint_names)
            recording.log(f"{root}/joints", rr.Points3D(joints, labels=labels, show_labels=False))
        if content.markers is not None:
            places = content.markers.positions[frame]
            known = np.isfinite(places).all(axis=1)
            names = [n for n, seen in zip(content.markers.names, known, strict=True) if seen]
            recording.log(f"{root}/markers", rr.Points3D(places[known], labels=names, show_labels=False))
        if content.rig is not None and content.picture is not None:
            for c, name in enumerate(content.rig.names):
                picture = content.picture(name, frame, PICTURE_WIDTH)
                scale = content.rig.sizes[c, 0] / picture.shape[1]
                lens = rr.Pinhole(
                    image_from_camera=_scaled(content.rig.cameras[c].calibration_matrix(), scale),
                    width=picture.shape[1],
                    height=picture.shape[0],
                    camera_xyz=rr.ViewCoordinates.RDF,
                )
                recording.log(f"{root}/cameras/{c}", lens)
                image = rr.EncodedImage(contents=webp(picture, 70), media_type="image/webp")
                recording.log(f"{root}/cameras/{c}/picture", image)


def _scaled(K: np.ndarray, factor: float) -> np.ndarray:
    """Calibration matrix of a picture that is `factor` times smaller."""
    scaled = K / factor
    scaled[2, 2] = 1
    return scaled
