from __future__ import annotations

import shutil

import cv2
import numpy as np
import pycolmap
import pytest

from geomocap.config import load_config
from geomocap.errors import CalibrationError, CaptureError
from geomocap.evaluation.camera_check import check_cameras_of
from geomocap.files.camera_file import read_camera_doubts
from geomocap.files.capture import Capture, CaptureInfo, labels_of, write_capture_info
from geomocap.files.rigs import write_rig
from geomocap.files.run import Run
from geomocap.inspection import describe
from geomocap.model.rig import Rig
from geomocap.model.rig_doubts import rig_doubts
from geomocap.pipeline import Job, agreeing, silhouettes
from geomocap.silhouettes.background import model_from_plate
from tests.geomocap.camera_scenes import SIZE, walk, walk_rig

FRAMES = 3


def scene(seed: int) -> np.ndarray:
    """A room: soft blobs of colour, other ones for each camera."""
    small = np.random.default_rng(seed).integers(60, 200, (7, 9, 3)).astype(np.uint8)
    return cv2.resize(small, SIZE, interpolation=cv2.INTER_CUBIC)


@pytest.fixture
def capture(tmp_path):
    """Four cameras with backgrounds, and pictures in which a bright figure walks."""
    folder, rig = tmp_path / "capture", walk_rig(4)
    for c, name in enumerate(rig.names):
        (folder / "images" / name).mkdir(parents=True)
        (folder / "background").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "background" / f"{name}.png"), scene(c))
    for k, row in enumerate(walk(rig, FRAMES)):
        for c, (name, mask) in enumerate(zip(rig.names, row, strict=True)):
            picture = np.where(mask[..., None] > 0, np.uint8([20, 230, 250]), scene(c))
            cv2.imwrite(str(folder / "images" / name / f"{k:06d}.png"), picture)
    write_rig(folder / "sparse", rig)
    write_capture_info(folder, CaptureInfo(name="walk", fps=10.0))
    return folder


def add_masks(folder, change=lambda m: m):
    rig = walk_rig(4)
    for k, row in enumerate(walk(rig, FRAMES)):
        for name, mask in zip(rig.names, row, strict=True):
            file = folder / "masks" / name / f"{k:06d}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), 255 * (change(mask) if name == "cam2" else mask))


def said(folder) -> str:
    return "\n".join(check_cameras_of(Capture.open(folder)).warnings)


def test_nothing_is_said_of_right_cameras(capture):
    assert said(capture) == ""
    assert describe(capture).problems == []


def test_pictures_of_one_camera_mirrored(capture):
    for file in [*(capture / "images" / "cam2").iterdir(), capture / "background" / "cam2.png"]:
        cv2.imwrite(str(file), cv2.imread(str(file))[:, ::-1])
    assert "camera cam2: its images seem mirrored" in said(capture)
    assert any("mirrored" in line for line in describe(capture).problems)


def test_pictures_of_one_camera_black(capture):
    for file in (capture / "images" / "cam2").iterdir():
        cv2.imwrite(str(file), np.zeros((72, 96, 3), np.uint8))
    found = check_cameras_of(Capture.open(capture))
    assert found.contradicting == ("cam2",)
    assert "one colour" in found.warnings[0]


def with_the_figure(plate, folder):
    """The figure stood elsewhere when the background was taken."""
    picture = cv2.imread(str(folder / "images" / "cam2" / "000001.png"))
    figure = np.roll((picture == (20, 230, 250)).all(axis=-1), 18, axis=1)
    return np.where(figure[..., None], np.uint8([20, 230, 250]), plate)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda plate, folder: scene(2), "background/cam2.png: camera cam3 sees that"),
        (lambda plate, folder: plate * 0, "background/cam2.png: differs from all pictures"),
        (lambda plate, folder: cv2.cvtColor(plate, cv2.COLOR_BGR2GRAY), "background/cam2.png: is grey"),
        (lambda plate, folder: np.dstack([plate, plate[..., 0] * 0]), "background/cam2.png: most of it is transparent"),
        (lambda plate, folder: None, "background/cam2.png: is missing"),
        (with_the_figure, "is its background right"),
    ],
)
def test_backgrounds_that_are_wrong(capture, change, says):
    file = capture / "background" / "cam2.png"
    plate = change(cv2.imread(str(file)), capture)
    file.unlink()
    if plate is not None:
        cv2.imwrite(str(file), plate)
    assert says in said(capture)


def job_of(folder, run, wish):
    opened = Capture.open(folder)
    return Job(Run(run), load_config(overrides={"cameras": {"that_disagree": wish}}), None, capture=opened, fps=10.0)


def test_cameras_that_disagree_are_told_left_out_or_end_the_run(capture, tmp_path):
    add_masks(capture, lambda m: m[::-1].copy())
    job, warnings = agreeing(job_of(capture, tmp_path / "warned", "warn"))
    assert job.capture.cameras == ("cam1", "cam2", "cam3", "cam4")
    assert "camera cam2" in warnings[0] and "upside down" in warnings[0]

    job, warnings = agreeing(job_of(capture, tmp_path / "left", "drop"))
    assert warnings[-1] == "left out: cam2"
    silhouettes(job)
    assert sorted(p.name for p in (tmp_path / "left" / "silhouettes").iterdir()) == ["cam1", "cam3", "cam4"]
    assert read_camera_doubts(Run(tmp_path / "left")).left_out == ("cam2",)

    with pytest.raises(CaptureError, match=r"cam2.*--cameras-that-disagree"):
        agreeing(job_of(capture, tmp_path / "stopped", "stop"))


def test_backgrounds_are_learnt_once_where_images_are_small(capture, tmp_path, monkeypatch):
    learnt = []

    def counted(plate, frames, settings, camera):
        learnt.append(camera)
        return model_from_plate(plate, frames, settings, camera)

    monkeypatch.setattr("geomocap.pipeline.correction_stage.model_from_plate", counted)
    job = job_of(capture, tmp_path / "once", "warn")
    silhouettes(job)
    assert learnt == ["cam1", "cam2", "cam3", "cam4"] and not job.backgrounds
    shutil.rmtree(tmp_path / "once" / "silhouettes")  # the correction is done: learnt anew, the same
    before = tmp_path / "before"
    silhouettes(job_of(capture, before, "warn"))
    silhouettes(job_of(capture, tmp_path / "once", "warn"))
    assert len(learnt) == 12
    for file in (before / "silhouettes").rglob("*.png"):
        assert file.read_bytes() == (tmp_path / "once" / file.relative_to(before)).read_bytes()


def test_too_few_cameras_are_not_left_alone(capture, tmp_path):
    add_masks(capture)
    for a, b in (("cam1", "cam2"),):
        shutil.move(capture / "masks" / a, capture / "masks" / "between")
        shutil.move(capture / "masks" / b, capture / "masks" / a)
        shutil.move(capture / "masks" / "between", capture / "masks" / b)
    text = (capture / "capture.toml").read_text()
    (capture / "capture.toml").write_text('cameras = ["cam1", "cam2", "cam3"]\n' + text)
    with pytest.raises(CaptureError, match="too few cameras"):
        agreeing(job_of(capture, tmp_path / "run", "drop"))


def test_units_and_focal_lengths_that_cant_be():
    rig = walk_rig(4)
    assert rig_doubts(rig) == []
    for scale, says in ((1000.0, "from the origin"), (0.001, "stands")):
        poses = np.array(rig.cam_from_world)
        poses[:, :, 3] *= scale
        doubts = rig_doubts(Rig(rig.names, rig.cameras, poses))
        assert (
            doubts and all("cam" in d for d in doubts) and "lengths must be metres" in doubts[0] and says in doubts[0]
        )
    cameras = [pycolmap.Camera(c.todict()) for c in rig.cameras]
    cameras[1].focal_length_x = cameras[1].focal_length_y = -85.0
    with pytest.raises(CalibrationError, match="camera cam2: focal lengths"):
        Rig(rig.names, tuple(cameras), rig.cam_from_world)


def test_labels_are_no_masks():
    mask = np.zeros((40, 40), np.uint8)
    mask[10:30, 10:30] = 255
    assert labels_of(mask) == []
    assert labels_of(cv2.GaussianBlur(mask, (5, 5), 0)) == []
    mask[12:28, 12:20] = 1
    assert labels_of(mask) == [0, 1, 255]


def test_large_images_are_decided_reduced_and_silhouettes_have_their_size(capture, tmp_path, monkeypatch):
    silhouettes(job_of(capture, tmp_path / "full", "warn"))
    monkeypatch.setattr("geomocap.pipeline.silhouette_stage.LONGEST", max(SIZE) // 2)
    job = job_of(capture, tmp_path / "reduced", "warn")
    silhouettes(job)
    assert not job.backgrounds
    for file in (tmp_path / "full" / "silhouettes").rglob("*.png"):
        full = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        found = cv2.imread(str(tmp_path / "reduced" / file.relative_to(tmp_path / "full")), cv2.IMREAD_UNCHANGED)
        assert found.shape == full.shape and set(np.unique(found)) == {0, 255}
        both, either = ((full > 0) & (found > 0)).sum(), ((full > 0) | (found > 0)).sum()
        assert 0.75 < both / either < 1.0, file  # limbs are three pixels wide
