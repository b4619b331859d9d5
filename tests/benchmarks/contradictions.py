"""Does the check of the cameras name what is wrong? Each contradiction in the second camera of a capture, in memory.

    python -m tests.benchmarks.contradictions CAPTURE [CAPTURE …] [--masks MASKS] [--size 96 72] [--cameras 4]

For each contradiction: named (what is said fits), warned (the camera is named), wrong (only another is), silent.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from geomocap.errors import GeomocapError
from geomocap.evaluation.camera_check import check_cameras_of
from geomocap.files.capture import Capture
from geomocap.files.images import read_image
from geomocap.model.rig import Rig

WRONG = 1  # the camera that is


@dataclass(frozen=True)
class Frames:
    """Frames of a camera, kept once they are read."""

    source: object
    size: tuple[int, int]
    kept: dict = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.source)

    def read(self, frame: int) -> np.ndarray:
        if frame not in self.kept:
            self.kept[frame] = cv2.resize(self.source.read(frame), self.size, interpolation=cv2.INTER_AREA)
        return self.kept[frame]


@dataclass(frozen=True)
class Changed:
    """Frames of a camera, changed."""

    source: Frames
    change: Callable[[np.ndarray], np.ndarray]
    late: int = 0

    @property
    def size(self) -> tuple[int, int]:
        return self.source.size

    def __len__(self) -> int:
        return len(self.source)

    def read(self, frame: int) -> np.ndarray:
        return np.ascontiguousarray(self.change(self.source.read((frame - self.late) % len(self))))


@dataclass(frozen=True)
class Staged(Capture):
    """A capture with other pictures, backgrounds, masks and cameras than in its folder."""

    plates: dict = field(default_factory=dict)
    masks: dict | None = None

    @property
    def has_masks(self) -> bool:
        return self.masks is not None

    def has_background(self, camera: str) -> bool:
        return camera in self.plates

    def background(self, camera: str) -> np.ndarray:
        return self.plates[camera]

    def mask(self, camera: str, frame: int) -> np.ndarray:
        return self.masks[camera].read(frame)


@dataclass(frozen=True)
class Masks:
    """Given silhouettes of a camera as frames."""

    folder: Path

    def __len__(self) -> int:
        return len(list(self.folder.glob("*.png")))

    def read(self, frame: int) -> np.ndarray:
        return read_image(self.folder / f"{frame:06d}.png", gray=True)


def staged(capture: Capture, size: tuple[int, int], cameras: int, masks: Path | None) -> Staged:
    """Open a capture in another size, some of its cameras."""
    names = [capture.cameras[k] for k in np.linspace(0, len(capture.cameras), cameras, endpoint=False).astype(int)]
    rig = capture.rig.select(names)
    smaller = [pycolmap.Camera(c.todict()) for c in rig.cameras]
    for camera in smaller:
        camera.rescale(*size)
    sources = {n: Frames(capture.sources[n], size) for n in names}
    plates = {n: cv2.resize(capture.background(n), size, interpolation=cv2.INTER_AREA) for n in names}
    given = None if masks is None else {n: Frames(Masks(masks / n), size) for n in names}
    result = Staged(capture.path, capture.info, tuple(names), sources, plates=plates, masks=given)
    result.__dict__["rig"] = Rig(tuple(names), tuple(smaller), rig.cam_from_world)
    return result


def with_rig(capture: Staged, rig: Rig) -> Staged:
    """Return a capture with other cameras."""
    result = replace(capture)
    result.__dict__["rig"] = rig
    return result


def pictured(capture: Staged, change: Callable[[np.ndarray], np.ndarray], late: int = 0, plate: bool = True) -> Staged:
    """Change what the camera shows, its background (and masks) too if wanted."""
    name = capture.cameras[WRONG]
    plates = {**capture.plates, name: np.ascontiguousarray(change(capture.plates[name]))} if plate else capture.plates
    masks = capture.masks and {**capture.masks, name: Changed(capture.masks[name], change, late)}
    sources = {**capture.sources, name: Changed(capture.sources[name], change, late)}
    return with_rig(replace(capture, sources=sources, plates=plates, masks=masks), capture.rig)


def masked(capture: Staged, change: Callable[[np.ndarray], np.ndarray]) -> Staged:
    """Change the camera's masks."""
    name = capture.cameras[WRONG]
    masks = {**capture.masks, name: Changed(capture.masks[name], change)}
    return with_rig(replace(capture, masks=masks), capture.rig)


def swapped(capture: Staged) -> Staged:
    """Change two cameras for each other."""
    a, b = capture.cameras[:2]

    def other(values: dict) -> dict:
        return {**values, a: values[b], b: values[a]}

    masks = capture.masks and other(capture.masks)
    changed = replace(capture, sources=other(capture.sources), plates=other(capture.plates), masks=masks)
    return with_rig(changed, capture.rig)


def posed(capture: Staged, turn: tuple[float, float, float], shift: tuple[float, float, float] = (0, 0, 0)) -> Staged:
    """Turn a camera by a rotation vector, and shift it, in its own axes."""
    poses = np.array(capture.rig.cam_from_world)
    poses[WRONG] = cv2.Rodrigues(np.array(turn, float))[0] @ poses[WRONG]
    poses[WRONG, :, 3] += shift
    return with_rig(capture, Rig(capture.rig.names, capture.rig.cameras, poses))


def inverted(capture: Staged) -> Staged:
    """Give a camera the inverse of its pose."""
    poses = np.array(capture.rig.cam_from_world)
    R, t = poses[WRONG, :, :3], poses[WRONG, :, 3]
    poses[WRONG] = np.column_stack([R.T, -R.T @ t])
    return with_rig(capture, Rig(capture.rig.names, capture.rig.cameras, poses))


def focal(capture: Staged, factor: float) -> Staged:
    """Multiply a camera's focal length."""
    cameras = [pycolmap.Camera(c.todict()) for c in capture.rig.cameras]
    cameras[WRONG].focal_length_x *= factor
    cameras[WRONG].focal_length_y *= factor
    return with_rig(capture, Rig(capture.rig.names, tuple(cameras), capture.rig.cam_from_world))


CASES: dict[str, tuple[Callable[[Staged], Staged], str]] = {
    "nothing": (lambda c: c, ""),
    "two swapped": (swapped, "mixed up"),
    "mirrored": (lambda c: pictured(c, lambda i: i[:, ::-1]), "mirrored"),
    "upside down": (lambda c: pictured(c, lambda i: i[::-1, ::-1]), "upside down"),
    "flipped": (lambda c: pictured(c, lambda i: i[::-1]), "upside down and mirrored"),
    "rolled by 90°": (lambda c: posed(c, (0, 0, np.pi / 2)), "rolled"),
    "turned by 20°": (lambda c: posed(c, (0, 0.35, 0)), "deny"),
    "2 m aside": (lambda c: posed(c, (0, 0, 0), (2, 0, 0)), "deny"),
    "pose inverted": (inverted, "deny|away"),
    "black": (lambda c: pictured(c, lambda i: i * 0, plate=False), "one colour|nothing"),
    "white": (lambda c: pictured(c, lambda i: i * 0 + 255, plate=False), "one colour|takes"),
    "mask inverted": (lambda c: masked(c, lambda m: 255 - m), "inverted"),
    "mask full": (lambda c: masked(c, lambda m: m * 0 + 255), "takes 100%"),
    "focal length doubled": (lambda c: focal(c, 2.0), "half of the calibrated"),
    "focal length halved": (lambda c: focal(c, 0.5), "twice the calibrated"),
    "focal length negative": (lambda c: focal(c, -1.0), "must be positive"),
    "another time": (lambda c: pictured(c, lambda i: i, late=max(1, len(c.sources[c.cameras[0]]) // 6)), "late|early"),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("capture", type=Path, nargs="+")
    parser.add_argument("--masks", type=Path, help="true masks of the capture; the only cases then are those of masks")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--match", default="")
    options = parser.parse_args()
    verdicts = Counter[str]()
    for path in options.capture:
        base = staged(Capture.open(path), tuple(options.size), options.cameras, options.masks)
        for name, (change, says) in CASES.items():
            if ("mask" in name) != (options.masks is not None) or options.match not in name:
                continue
            start = time.perf_counter()
            try:
                warnings = list(check_cameras_of(change(base)).warnings)
            except GeomocapError as error:  # a camera that can't be, refused
                warnings = [str(error)]
            seconds = time.perf_counter() - start
            camera = base.cameras[WRONG]
            lines = [w for w in warnings if camera in w]
            fits = any(part in w for w in lines for part in says.split("|")) and bool(says)
            verdict = "named" if fits else "warned" if lines else "wrong" if warnings else "silent"
            if name == "nothing":
                verdict = "false" if warnings else "right"
            verdicts[verdict] += 1
            print(f"{path.name:12} {name:22} {verdict:7} {seconds:5.1f} s  {'; '.join(warnings)}", flush=True)
    print(f"{options.cameras} cameras, {options.size[0]}×{options.size[1]}: {dict(verdicts)}")


if __name__ == "__main__":
    main()
