from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from data_tools.bar import BarRecording, picture_bar
from data_tools.camera_views import DistortedView, look_at
from data_tools.figure import figure
from data_tools.image_rendering import PosedSubject, render_subject
from data_tools.placement import make_camera
from data_tools.room import Light
from data_tools.shading import ShadedSurface
from data_tools.solid_noise import fabric_noise, gradient_noise
from data_tools.synthesize import SynthesisResult, SynthesisSettings, make_world, synthesize
from geomocap.errors import CaptureError
from geomocap.files.capture import Capture
from geomocap.files.rigs import read_rig
from geomocap.model.ray_casting import touched_pixels
from geomocap.model.rig import Rig
from geomocap.scheduling import threads

SMALL = SynthesisSettings(cameras=3, width=160, height=120, fps=10, frames=3, noise=0, shadow=False, exposure=0, bar=4)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Path, SynthesisResult]:
    """A small capture without noise and shadow, its truth, and the report."""
    folder = tmp_path_factory.mktemp("synthetic")
    result = synthesize(figure(), folder / "capture", folder / "truth", SMALL)
    return Capture.open(folder / "capture"), folder / "truth", result


def truth_mask(truth: Path, camera: str, frame: int) -> np.ndarray:
    return cv2.imread(str(truth / "masks" / camera / f"{frame:06d}.png"), cv2.IMREAD_GRAYSCALE) > 0


def digest(folder: Path) -> dict[str, str]:
    files = [f for f in sorted(folder.rglob("*")) if f.suffix in (".png", ".txt", ".toml", ".mp4")]
    return {str(f.relative_to(folder)): hashlib.blake2b(f.read_bytes()).hexdigest() for f in files}


# --- rays ---


def test_rays_of_a_pixel_are_centred_on_it() -> None:
    camera = make_camera(320, 240, 60, 2.0, np.random.default_rng(0))
    rig = Rig(("a",), (camera,), look_at(np.array([3.0, 1, 2]), np.zeros(3))[None])
    view = DistortedView.of(rig, 0)
    pixels = np.array([0, 319, 120 * 320 + 160, 239 * 320])
    for samples in (1, 2, 4):
        rays = view.rays(pixels, samples).astype(np.float64)
        points = rays[..., :3] + 2.0 * rays[..., 3:]
        seen = rig.project(points.reshape(-1, 3))[0].reshape(len(pixels), -1, 2)
        center = np.column_stack([pixels % 320 + 0.5, pixels // 320 + 0.5])
        np.testing.assert_allclose(seen.mean(axis=1), center, atol=1e-3)
        spread = ((np.arange(samples) + 0.5) / samples - 0.5).std()
        np.testing.assert_allclose(seen.std(axis=1), spread, atol=1e-3)
        np.testing.assert_allclose(rays[..., 3:] @ rig.viewing_directions[0], 1, atol=1e-6)  # unit depth


def test_touched_pixels_hold_all_that_is_hit() -> None:
    vertices = figure().vertices(0.2)
    world = make_world(vertices[None], SMALL)
    surface = ShadedSurface.of(figure(), world.footprint, 0.28, 0)
    subject = PosedSubject.of(surface, vertices)
    for c in range(len(world.rig)):
        view = DistortedView.of(world.rig, c)
        everything = np.arange(160 * 120)
        rays = view.rays(everything, 4).reshape(-1, 6)
        hit = np.isfinite(subject.scene.cast(rays)[0]).reshape(-1, 16)
        touched = touched_pixels(world.rig.project(vertices)[c], surface.faces, 160, 120)
        assert touched.ravel()[hit.any(axis=1)].all()
        # And the coverage is that of all these rays
        pixels, coverage, _ = render_subject(subject, surface, world.rig, c, view, Light.studio())
        full = np.zeros(160 * 120)
        full[pixels] = coverage
        edge = (hit.mean(axis=1) > 0) & (hit.mean(axis=1) < 1)
        assert np.mean(full[edge] == hit.mean(axis=1)[edge]) > 0.97
        np.testing.assert_allclose(full, hit.mean(axis=1), atol=0.26)


# --- texture ---


def reference_noise(x: float, y: float, z: float, seed: int) -> float:
    """The definition, in plain Python: gradients at the corners of the cell, blended by quintic weights."""
    base = [int(np.floor(v)) for v in (x, y, z)]
    part = [v - b for v, b in zip((x, y, z), base, strict=True)]
    edges = [(1, 1, 0), (-1, 1, 0), (1, -1, 0), (-1, -1, 0), (1, 0, 1), (-1, 0, 1), (1, 0, -1), (-1, 0, -1),
             (0, 1, 1), (0, -1, 1), (0, 1, -1), (0, -1, -1), (1, 1, 0), (0, -1, 1), (-1, 1, 0),
             (0, -1, -1)]  # fmt: skip
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        i, j, k = (b + c for b, c in zip(base, corner, strict=True))
        h = (i * 374761393 + j * 668265263 + k * 2147483647 + seed * 1274126177) % 2**32
        h = ((h ^ (h >> 13)) * 1274126177) % 2**32
        h = ((h ^ (h >> 16)) * 2246822519) % 2**32
        gradient = edges[(h ^ (h >> 15)) & 15]
        weight = 1.0
        for p, c in zip(part, corner, strict=True):
            fade = p**3 * (p * (p * 6 - 15) + 10)
            weight *= fade if c else 1 - fade
        total += weight * sum(g * (p - c) for g, p, c in zip(gradient, part, corner, strict=True))
    return total


def test_solid_noise_is_as_defined() -> None:
    for point in np.random.default_rng(3).uniform(-50, 50, (200, 3)):
        assert gradient_noise(*point, 7) == pytest.approx(reference_noise(*point, 7), abs=1e-12)


def test_fabric_has_the_contrast_asked_for() -> None:
    asset = figure()
    surface = ShadedSurface.of(asset, 0.004, 0.28, 0)
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    values = [fabric_noise(*p, surface.cells, surface.weights, 0) for p in points]
    assert np.mean(values) == pytest.approx(0, abs=0.02)
    assert np.std(values) == pytest.approx(0.28, rel=0.1)


# --- a capture ---


def test_capture_opens_and_knows_its_cameras(made) -> None:
    capture, truth, result = made
    assert (capture.n_frames, capture.fps, capture.info.up) == (3, 10, "z")
    assert capture.cameras == ("cam01", "cam02", "cam03")
    np.testing.assert_allclose(capture.rig.cam_from_world, result.rig.cam_from_world, atol=1e-12)
    np.testing.assert_allclose(read_rig(truth / "sparse").cam_from_world, result.rig.cam_from_world, atol=1e-12)
    assert all(c.model.name == "OPENCV" for c in capture.rig.cameras)
    assert len({tuple(c.params) for c in capture.rig.cameras}) == 3  # each lens its own
    assert all(capture.has_background(c) for c in capture.cameras)


def test_truth_is_complete(made) -> None:
    _, truth, _ = made
    content = dict(np.load(truth / "truth.npz"))
    asset = figure()
    T, V, J = 3, len(asset.bind_vertices), len(asset.joint_names)
    assert content["vertices"].shape == (T, V, 3)
    assert content["vertex_weights"].shape == (V, J)
    assert content["joint_positions"].shape == (T, J, 3)
    assert content["joint_rotations"].shape == (T, J, 3, 3)
    assert content["joint_names"].tolist() == list(asset.joint_names)
    assert content["joint_parents"].min() == -1
    assert content["fps"] == 10
    np.testing.assert_array_equal(content["vertex_joint"], content["vertex_weights"].argmax(axis=1))
    np.testing.assert_allclose(
        content["joint_rotations"] @ content["joint_rotations"].transpose(0, 1, 3, 2),
        np.broadcast_to(np.eye(3), (T, J, 3, 3)),
        atol=1e-9,
    )
    assert content["vertices"][:, :, 2].min() > -1e-3  # the floor; the lowest point may lie between frames


def test_whole_motion_fills_every_picture(made) -> None:
    capture, truth, _ = made
    vertices = np.load(truth / "truth.npz")["vertices"].reshape(-1, 3)
    size = np.array([160, 120])
    reach = np.abs(capture.rig.project(vertices) / size * 2 - 1).max(axis=(1, 2))
    assert np.all(reach <= 0.9201)
    assert np.all(reach > 0.85)


def test_true_masks_are_the_projected_surface(made) -> None:
    capture, truth, _ = made
    content = np.load(truth / "truth.npz")
    for t in range(3):
        for c, name in enumerate(capture.cameras):
            mask = truth_mask(truth, name, t)
            pixels = capture.rig.project(content["vertices"][t])[c]
            rows, columns = np.nonzero(mask)
            box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            expected = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
            np.testing.assert_allclose(box, expected, atol=1.0)
            # Projected triangles, filled at 16 times the resolution, cover the same pixels
            canvas = np.zeros((120 * 16, 160 * 16), np.uint8)
            for triangle in pixels[content["faces"]]:
                cv2.fillConvexPoly(canvas, np.rint(triangle * 16 - 0.5).astype(np.int32), 1)
            covered = canvas.reshape(120, 16, 160, 16).mean(axis=(1, 3))
            assert np.all(mask[covered > 0.65])
            assert not np.any(mask[covered < 0.35])


def test_images_differ_from_the_background_exactly_at_the_subject(made) -> None:
    capture, truth, _ = made
    for name in capture.cameras:
        image, plate = capture.frame(name, 1).astype(int), capture.background(name)[..., :3].astype(int)
        changed = np.abs(image - plate).max(axis=2) > 6
        mask = truth_mask(truth, name, 1)
        near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) > 0
        assert not np.any(changed & ~near)
        assert np.mean(changed[mask]) > 0.95
        assert image[mask].std() > 25  # there is texture to match on


def test_bar_targets_are_where_the_truth_says(made) -> None:
    capture, truth, _ = made
    bar = np.load(truth / "bar.npz")
    assert bar["points"].shape == (4, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(bar["points"][:, 1] - bar["points"][:, 0], axis=1), bar["length"])
    assert f"length = {float(bar['length'])}" in (capture.path / "bar" / "bar.toml").read_text()
    for p, pair in enumerate(bar["points"]):
        pixels = capture.rig.project(pair)
        for c, name in enumerate(capture.cameras):
            picture = cv2.imread(str(capture.path / "bar" / name / f"{p:06d}.png"), cv2.IMREAD_GRAYSCALE)
            for u, v in pixels[c]:
                assert picture[int(v), int(u)] > 150
            assert np.mean(picture < 40) > 0.98


@pytest.mark.parametrize("size", [(320, 240), (640, 480)])
def test_centroids_of_targets_are_their_centres(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("data_tools.bar.ROD_LEVEL", 0.0)
    settings = SMALL.model_copy(update={"width": size[0], "height": size[1]})
    vertices = figure().vertices(0.0)
    world = make_world(vertices[None], settings)
    bar = BarRecording.plan(world.rig, world.low, world.high, 12, None, world.footprint, 1)
    dark = np.zeros((size[1], size[0], 3), np.float32)
    errors = []
    for c in range(len(world.rig)):
        view = DistortedView.of(world.rig, c)
        for pair in bar.targets:
            image = picture_bar(dark, view, world.rig, c, pair, bar.radius)[:, :, 0]
            both = world.rig.project(pair)[c]
            if np.abs(both[1] - both[0]).max() < 14:
                continue  # one would be in the other's window
            for u, v in both:
                x, y = int(u), int(v)
                part = image[y - 7 : y + 8, x - 7 : x + 8]
                rows, columns = np.mgrid[y - 7 : y + 8, x - 7 : x + 8] + 0.5
                total = part.sum()
                errors.append([(part * columns).sum() / total - u, (part * rows).sum() / total - v])
    assert len(errors) > 60
    assert np.linalg.norm(errors, axis=1).max() < 0.02


def test_bar_fills_the_volume_in_all_directions(made) -> None:
    _, truth, result = made
    vertices = np.load(truth / "truth.npz")["vertices"].reshape(-1, 3)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    bar = BarRecording.plan(result.rig, low, high, 60, 0.5, result.footprint, 0)
    direction = (bar.targets[:, 1] - bar.targets[:, 0]) / 0.5
    spread = np.linalg.eigvalsh(direction.T @ direction / 60)
    assert spread.min() > 0.15  # a third each would be uniform
    assert np.all(np.ptp(bar.targets.reshape(-1, 3), axis=0) > 0.7 * (high - low))


# --- settings ---


def test_noise_has_the_strength_asked_for(tmp_path: Path) -> None:
    settings = SMALL.model_copy(update={"noise": 2.0, "frames": 2, "bar": 0})
    synthesize(figure(), tmp_path / "c", tmp_path / "t", settings)
    noisy = Capture.open(tmp_path / "c")
    plate = noisy.background("cam01")[..., :3].astype(float)
    image = noisy.frame("cam01", 0).astype(float)
    empty = cv2.dilate(truth_mask(tmp_path / "t", "cam01", 0).astype(np.uint8), np.ones((5, 5))) == 0
    difference = (image - plate)[empty]
    assert difference.std() == pytest.approx(np.sqrt(2 * (4 + 1 / 12)), rel=0.05)  # two pictures, each rounded
    assert abs(difference.mean()) < 0.1
    assert not np.array_equal(noisy.frame("cam01", 0), noisy.frame("cam01", 1))


def test_same_seed_same_files_whatever_the_threads(tmp_path: Path) -> None:
    settings = SMALL.model_copy(update={"noise": 1.0, "shadow": True, "frames": 2, "cameras": 2, "bar": 2})
    for name, workers in (("one", 1), ("three", 3)):
        with threads(workers) as executor:
            synthesize(figure(), tmp_path / name / "c", tmp_path / name / "t", settings, executor=executor)
    assert digest(tmp_path / "one") == digest(tmp_path / "three")
    other = settings.model_copy(update={"seed": 5})
    synthesize(figure(), tmp_path / "other" / "c", tmp_path / "other" / "t", other)
    assert digest(tmp_path / "one") != digest(tmp_path / "other")


def test_shadow_darkens_the_floor_under_the_subject_only(tmp_path: Path, made) -> None:
    capture, truth, _ = made
    synthesize(figure(), tmp_path / "c", tmp_path / "t", SMALL.model_copy(update={"shadow": True, "bar": 0}))
    shaded = Capture.open(tmp_path / "c")
    for name in capture.cameras:
        change = shaded.frame(name, 0).astype(int) - capture.frame(name, 0)
        assert change.max() <= 0
        assert change.min() < -8
        assert np.all(change[truth_mask(truth, name, 0)] > -40)
        assert np.mean(change.min(axis=2) < -3) < 0.3


def test_video_and_withheld_calibration(tmp_path: Path, made) -> None:
    capture, _, _ = made
    settings = SMALL.model_copy(update={"video": True, "withhold_calibration": True, "bar": 0})
    synthesize(figure(), tmp_path / "c", tmp_path / "t", settings)
    filmed = Capture.open(tmp_path / "c")
    assert (filmed.n_frames, filmed.is_calibrated) == (3, False)
    assert read_rig(tmp_path / "t" / "sparse").names == capture.cameras
    for t in (2, 0):
        off = filmed.frame("cam02", t).astype(int) - capture.frame("cam02", t)
        assert np.abs(off).mean() < 4  # lossy, and colours at half the resolution
    assert sorted(p.name for p in (tmp_path / "c" / "videos").iterdir()) == ["cam01.mp4", "cam02.mp4", "cam03.mp4"]


def test_arc_and_fixed_cameras(tmp_path: Path) -> None:
    vertices = figure().vertices(0.0)
    settings = SMALL.model_copy(
        update={"arc_deg": 90.0, "camera_height": 1.2, "camera_distance": 6.0, "distortion": 0.0}
    )
    rig = make_world(vertices[None], settings).rig
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    away = rig.centers - middle
    np.testing.assert_allclose(rig.centers[:, 2], 1.2)
    np.testing.assert_allclose(np.linalg.norm(away[:, :2], axis=1), 6.0)
    angles = np.rad2deg(np.arctan2(away[:, 1], away[:, 0]))
    np.testing.assert_allclose(angles, [-135, -90, -45], atol=1e-9)
    assert rig.is_pinhole


def test_looping_is_said_and_occupied_folders_are_kept(tmp_path: Path, made) -> None:
    capture, _, result = made
    assert result.notes == ()
    with pytest.raises(CaptureError, match="holds images already"):
        synthesize(figure(), capture.path, tmp_path / "t", SMALL)
    settings = SynthesisSettings(cameras=1, width=32, height=24, fps=1, frames=4, bar=0)
    looped = synthesize(figure(), tmp_path / "c", tmp_path / "t", settings)
    assert "played in a loop" in looped.notes[0]


@pytest.mark.parametrize(("name", "animation"), [("CesiumMan.glb", None), ("horse-animations.glb", "Walk")])
def test_characters_become_captures(data: Path, tmp_path: Path, name: str, animation: str | None) -> None:
    from data_tools.gltf_reader import load_gltf

    settings = SynthesisSettings(cameras=2, width=160, height=120, fps=15, frames=2)
    synthesize(load_gltf(data / "characters" / name, animation), tmp_path / "c", tmp_path / "t", settings)
    capture = Capture.open(tmp_path / "c")
    for camera in capture.cameras:
        mask = truth_mask(tmp_path / "t", camera, 1)
        assert 0.03 < mask.mean() < 0.5
        subject = capture.frame(camera, 1)[mask]
        assert 70 < subject.mean() < 170
        assert subject.mean(axis=1).std() > 20
        assert np.mean(subject > 252) < 0.05  # hardly overexposed
