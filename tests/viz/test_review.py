"""A whole review of a small run: sheets, plots, video, report; and of runs in which parts are missing."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import av
import numpy as np
import open3d as o3d
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geomocap.errors import RunError
from geomocap.files.atomic import write_text
from geomocap.files.camera_file import CameraDoubts, write_camera_doubts
from geomocap.files.frame_files import ply_count, write_points
from geomocap.files.run import Run
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.frame_geometry import BodyPoints
from geomocap.model.rotations import rotation_vectors
from tests.viz.conftest import LIMBS, Made
from viz import review, scene
from viz.camera_pictures import frusta
from viz.drawing import write_png
from viz.figures import joint_angles
from viz.films import best_camera, motion_video, write_video
from viz.quality_figures import assess, coverage, relative_paths
from viz.report import Block, Report, Section, render_html, table, video
from viz.run_contents import Results
from viz.scene import stage
from viz.sections import bodies_table, camera_remarks, cameras_table, changed_files
from viz.sheets import overlay, path_sheet
from viz.shown_names import named
from viz.volumes import cubes


@pytest.fixture(scope="session")
def reviewed(made: Made) -> list[Path]:
    calls: list[tuple[str, int, int]] = []
    files = review(made.run, made.capture, frames=[0, 5], progress=lambda *call: calls.append(call))
    assert calls[0][1] == 0 and all(d <= n for _, d, n in calls) and calls[-1][1] == calls[-1][2]
    return files


def test_review_writes_every_picture_and_the_report_last(made: Made, reviewed: list[Path]) -> None:
    assert all(f.is_file() and f.parent == made.run.path / "review" for f in reviewed)
    assert not list((made.run.path / "review").glob(".*"))
    names = {f.stem for f in reviewed}
    assert reviewed[-1].name == "report.html"
    assert {"motion", "stages", "cameras", "silhouettes", "volume", "ellipsoids", "paths", "bodies"} <= names
    assert {"skeleton", "skeleton_overlay", "joint_angles", "integrals", "timings"} <= names
    for file in reviewed:
        if file.suffix == ".png":
            with Image.open(file) as image:
                pixels = np.asarray(image.convert("RGB"))
            assert min(pixels.shape[:2]) > 100 and pixels.std() > 5, file.name


def test_video_is_what_browsers_play(reviewed: list[Path]) -> None:
    file = next(f for f in reviewed if f.suffix == ".mp4")
    data = file.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # the index first
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.width % 2 == 0 and stream.height % 2 == 0
        assert float(stream.average_rate) == 30
        assert sum(1 for _ in container.decode(stream)) == 6


def test_report_is_one_self_contained_page(reviewed: list[Path]) -> None:
    whole = reviewed[-1].read_text(encoding="utf-8")
    assert len(whole) < 12_000_000
    page = re.sub(r"<script[ >].*?</script>", "", whole, flags=re.S)  # what these draw is in test_turntable
    sources = re.findall(r"""(?:src|href|poster|data)\s*=\s*["']([^"']*)""", page)
    assert len(sources) > 20
    assert all(s.startswith(("data:image/webp;base64,", "data:video/mp4;base64,", "#")) for s in sources)
    assert not re.search(r"@import|url\(|<link", page) and "default-src 'none'" in page
    anchors = set(re.findall(r'href="#([^"]*)"', page))
    assert anchors and anchors <= set(re.findall(r'id="([^"]*)"', page))
    for word in ("stick figure", "10 rigid bodies", "9 joints", "forearm_l", "cam1", "resolution = 128", "silhouettes"):
        assert word in page
    assert "The run has no" not in page


def test_pictures_repeat_to_the_bit(made: Made, reviewed: list[Path], tmp_path: Path) -> None:
    results = Results(made.run, made.capture)
    place = stage(results)
    motion_video(results, place, tmp_path / "motion.mp4")
    assert (tmp_path / "motion.mp4").read_bytes() == (made.run.path / "review" / "motion.mp4").read_bytes()
    write_png(tmp_path / "paths.png", path_sheet(results, place, 0))
    assert (tmp_path / "paths.png").read_bytes() == (made.run.path / "review" / "paths.png").read_bytes()
    assert results.skeleton is not None
    assert joint_angles(results.skeleton, 30.0) == (made.run.path / "review" / "joint_angles.png").read_bytes()


def test_a_quick_report_shows_two_frames_and_the_same_film(made: Made, reviewed: list[Path], tmp_path: Path) -> None:
    shutil.copytree(made.run.path, tmp_path / "run", ignore=shutil.ignore_patterns("review"))
    (tmp_path / "run" / "skeleton.npz").unlink()  # the fewer pictures
    written = {f.name: f for f in review(Run(tmp_path / "run"), quick=True)}
    sizes = []
    for file in (written["volume.png"], made.run.path / "review" / "volume.png"):
        with Image.open(file) as image:
            sizes.append(image.size)
    assert sizes[0] == sizes[1]  # two frames here as well
    with av.open(str(written["motion.mp4"])) as container:
        assert sum(1 for _ in container.decode(video=0)) == 6


def test_cameras_that_contradict_and_names_are_told(made: Made, tmp_path: Path) -> None:
    run = Run(shutil.copytree(made.run.path, tmp_path / "run"))
    word = "cam1 contradicts the others: it seems mirrored"
    write_camera_doubts(run, CameraDoubts(("cam1",), (), (word,)))
    (run.path / "names.toml").write_text('[bodies]\n"left_shin" = 7\n[joints]\n"left_knee" = 6\n')
    results = named(Results(run, made.capture))
    assert word in assess(results, [0]).warnings
    (block,) = camera_remarks(results)
    assert block.items == (word,)
    cells = {row[0]: row[-1] for row in cameras_table(results).rows}
    assert cells == {"cam0": "", "cam1": "contradicts the others", "cam2": ""}
    data = frusta(results, "z")["cameras"]
    assert [c["doubtful"] for c in data] == [False, True, False]
    told = bodies_table(results, 0)
    assert told.rows[7][0] == "left_shin" and "left_knee" in told.rows[7][-1]
    (run.path / "names.toml").write_text('"no name" = 7\n')
    assert bodies_table(named(Results(run, made.capture)), 0).rows[7][0] == "body07"
    write_camera_doubts(run, CameraDoubts(("cam1",), ("cam1",), (word,)))
    (block,) = camera_remarks(Results(run, made.capture))
    assert "without cam1" in block.items[-1]
    assert camera_remarks(Results(made.run, made.capture)) == []


def test_files_that_are_not_as_they_were_written_are_named(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.begin("tracks", "key", ["tracks.npz"])
    write_text(tmp_path / "tracks.npz", "<tracks>" * 9)
    run.finish("tracks")
    assert changed_files(Results(run)) == []
    (tmp_path / "tracks.npz").write_text("<tracks>")
    (block,) = changed_files(Results(run))
    assert block.kind == "warnings" and block.items[1] == "tracks.npz is cut (8 of 72 bytes)."


@pytest.mark.parametrize(
    ("kept", "sentence"),
    [
        (["silhouettes"], "holds no geometry yet"),
        (["voxels"], "has no skeleton"),
        (["ellipsoids.npz"], "has no rigid bodies"),
        (["bodies", "skeleton.npz"], "has neither voxels nor a point cloud"),
    ],
)
def test_missing_parts_are_named_and_left_out(made: Made, tmp_path: Path, kept: list[str], sentence: str) -> None:
    for name in kept:
        source = made.run.path / name
        if source.is_dir():
            shutil.copytree(source, tmp_path / "run" / name)
            for late in (tmp_path / "run" / name).rglob("00000[1-5].*"):
                late.unlink()
        else:
            (tmp_path / "run").mkdir(exist_ok=True)
            shutil.copy(source, tmp_path / "run" / name)
    files = review(Run(tmp_path / "run"), None, frames=[0])
    page = files[-1].read_text(encoding="utf-8")
    assert sentence in page
    assert "No capture is at hand" in page and "How the bodies were told apart" not in page


def test_one_scan_has_no_video_and_no_paths(made: Made, tmp_path: Path) -> None:
    positions, _ = made.figure.points(0, 200)
    (tmp_path / "cloud").mkdir()
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(positions.astype(np.float32)))
    o3d.t.io.write_point_cloud(str(tmp_path / "cloud" / "000000.ply"), cloud)
    files = review(Run(tmp_path))
    assert not [f for f in files if f.suffix == ".mp4"]
    assert "a scan" in files[-1].read_text(encoding="utf-8")


@pytest.mark.parametrize(("fraction", "times"), [(1.0, 0), (0.5, 1), (0.05, 1)])
def test_points_without_a_body_are_told_once_and_not_where_none_was_looked_for(tmp_path, fraction, times) -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    label = np.where(np.arange(200) < 200 * fraction, -1, 0).astype(np.int32)
    write_points(Run(tmp_path).frame_file("bodies", 0), BodyPoints(points, label))
    page = review(Run(tmp_path))[-1].read_text(encoding="utf-8")
    assert page.count("% of the points belong to no body") == times


def test_empty_run_and_unknown_frame_are_refused(made: Made, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="holds no silhouettes and no geometry"):
        review(Run(tmp_path))
    with pytest.raises(RunError, match="frame 77 is not in the run; choose from 0 to 5"):
        review(made.run, made.capture, frames=[77])


def test_damaged_arrays_are_named(made: Made, tmp_path: Path) -> None:
    shutil.copytree(made.run.path / "voxels", tmp_path / "voxels")
    Run(tmp_path).write_npz("skeleton.npz", joint_positions=np.zeros((6, 1, 3)))
    with pytest.raises(RunError, match=r"skeleton\.npz: has no array joint_bodies"):
        review(Run(tmp_path))


# --- parts ---


def test_results_read_what_was_written(made: Made) -> None:
    results = Results(made.run, made.capture)
    assert results.frames == list(range(6)) and results.up == "z" and results.fps == 30
    assert results.skeleton is not None
    assert results.skeleton.leaves == [1, 3, 5, 7, 9]
    assert {b for b, _, _ in results.skeleton.bones} == {0, 2, 4, 6, 8}
    assert results.counts["voxels"][0] == len(results.voxels(0).indices)
    assert ply_count(made.run.frame_file("bodies", 0)) == len(results.bodies(0).positions)
    assert set(np.unique(results.bodies(0).body)) == set(range(-1, len(LIMBS)))
    turned = results.skeleton.joint_rotations()
    swing = LIMBS[2][5] * np.sin(2 * np.pi * 5 / 30)
    np.testing.assert_allclose(turned[5, 1], [swing, 0, 0], atol=1e-6)


def test_overlay_lies_on_the_photographed_figure(made: Made) -> None:
    """The figure was drawn through the distorted cameras; its rendering must fall on the same pixels."""
    from viz.body_colors import body_color
    from viz.rendering import Model
    from viz.scene import body_skin

    results = Results(made.run, made.capture)
    red = body_skin(results, 3).recolored((255, 0, 0))
    changed = overlay(results, "cam1", 3, Model([red]), 160).astype(int)
    painted = changed[..., 0] - changed[..., 1] > 60
    mask = results.silhouette("cam1", 3)
    assert mask is not None
    inside = mask > 0
    assert (painted & inside).sum() / (painted | inside).sum() > 0.8
    assert body_color(0) != (255, 0, 0)


def test_bodies_look_alike_whether_or_not_the_volume_was_drawn_before(made: Made) -> None:
    results, others = Results(made.run, made.capture), Results(made.run, made.capture)
    volume, after, alone = scene.volume(results, 3), scene.bodies(results, 3), scene.bodies(others, 3)
    assert after.outlined and not volume.outlined
    assert (after.colors != volume.colors).any()
    for field in ("vertices", "faces", "normals", "colors"):
        np.testing.assert_array_equal(getattr(after, field), getattr(alone, field))
    grid = results.voxels(3)
    fewer, colors = grid.indices[::-2], grid.colors[::-2]
    np.testing.assert_array_equal(
        scene._cubes(results, 3, grid, fewer, colors).vertices,
        cubes(fewer, grid.origin, grid.voxel_size, colors).vertices,
    )


def test_quality_of_the_figure(made: Made) -> None:
    quality = assess(Results(made.run, made.capture), [0, 3])
    assert all(covered > 0.8 for covered, _ in quality.agreement.values())
    assert max(b.spread for b in quality.bones) < 1e-9
    assert quality.unassigned == pytest.approx(1 / 97, rel=0.1)
    assert not [w for w in quality.warnings if "bones" in w or "joints" in w]


def test_warnings_say_what_is_wrong(made: Made, tmp_path: Path) -> None:
    shutil.copytree(made.run.path, tmp_path / "run")
    run = Run(tmp_path / "run")
    arrays = run.read_npz("skeleton.npz")
    arrays["joint_positions"][::2, 3] += 0.3
    run.write_npz("skeleton.npz", **arrays)
    Image.new("L", (160, 120)).save(run.silhouette_file("cam0", 2))
    (run.path / "diagnostics.json").write_text('{"warnings": ["the light changes"]}')
    said = " ".join(assess(Results(run, made.capture), [0]).warnings)
    assert "cam0: the silhouette is empty in 1 of 6 frames" in said
    assert "jump from frame to frame: arm_r" in said
    assert "bones change their length" in said
    assert "the light changes" in said


def test_coverage_notices_the_border(made: Made, tmp_path: Path) -> None:
    mask = np.zeros((40, 60), np.uint8)
    mask[10:20, 50:] = 255
    file = Run(tmp_path).silhouette_file("a", 0)
    file.parent.mkdir(parents=True)
    Image.fromarray(mask).save(file)
    found = coverage(Results(Run(tmp_path)))
    assert found is not None
    assert found.fraction[0, 0] == pytest.approx(100 / 2400)
    assert found.cut[0, 0]


def test_relative_paths_of_one_body_have_no_distance(made: Made) -> None:
    results = Results(made.run)
    e = results.ellipsoids
    assert e is not None
    paths = relative_paths(e, Diagnostics(seeds=np.array([10]), threshold=0.02))
    assert paths.seed == 10 and paths.threshold == 0.02  # 0 and 10 are the trunk's, which does not turn
    np.testing.assert_allclose(paths.distance[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(np.diag(paths.integrals), 0)
    assert paths.integrals[10, 3] > 0.005


def test_ellipsoids_without_points_are_not_drawn(made: Made, tmp_path: Path) -> None:
    arrays = made.run.read_npz("ellipsoids.npz")
    counts = np.ones(arrays["centers"].shape[:2], int)
    counts[:2, 3] = counts[:, 4] = 0
    arrays["counts"], arrays["centers"][counts == 0] = counts, 50.0
    run = Run(tmp_path)
    run.write_npz("ellipsoids.npz", **arrays)
    results = Results(run)
    e = results.ellipsoids
    assert e is not None
    assert np.abs(results.any_points(0)).max() < 10
    assert np.abs(scene.ellipsoids(results, 0).vertices).max() < 10
    assert np.abs(scene.paths(results, 1.7).vertices).max() < 10
    relative = relative_paths(e, Diagnostics())
    assert np.isnan(relative.distance[:2, 3]).all() and np.isfinite(relative.distance[2:, 3]).all()
    assert np.isfinite(relative.integrals[3, 5]) and np.isnan(relative.integrals[4]).all()


def test_video_camera_looks_at_the_broad_side(made: Made) -> None:
    results = Results(made.run, made.capture)
    place = stage(results)
    camera = best_camera(results, place)
    assert camera in made.rig.names
    assert best_camera(Results(made.run), place) is None


def test_odd_sizes_are_made_even(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [np.full((33, 51, 3), 90, np.uint8)] * 3, 12.5)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == (52, 34)
    with pytest.raises(RunError, match="no frames"):
        write_video(tmp_path / "b.mp4", [], 12.5)
    assert not (tmp_path / "b.mp4").exists()


def test_text_in_the_report_is_escaped() -> None:
    blocks = (Block("text", "<script>alert(1)</script>"), table(("a",), [("<b>",)]))
    page = render_html(Report("A & B", "", sections=(Section("S", "s", blocks), Section("Empty", "e", ()))))
    assert "<script" not in page and "&lt;b&gt;" in page and "A &amp; B" in page
    assert "Empty" not in page


def test_large_videos_are_linked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "motion.mp4"
    file.write_bytes(b"x" * 100)
    assert video(file, "", "").source.startswith("data:video/mp4;base64,")
    monkeypatch.setattr("viz.report.EMBEDDED_VIDEO", 10)
    assert video(file, "", "").source == "motion.mp4"


def test_joint_rotations_go_on_past_half_a_turn() -> None:
    angles = np.radians(np.arange(0, 300, 30.0))
    turns = Rotation.from_rotvec(np.outer(angles, [0, 0, 1])).as_matrix()
    np.testing.assert_allclose(rotation_vectors(turns[:, None])[:, 0, 2], angles, atol=1e-9)


def test_arrays_of_all_frames_fit_a_run_that_keeps_some_geometry(made: Made, tmp_path: Path) -> None:
    shutil.copytree(made.run.path, tmp_path / "run")
    for kind in ("voxels", "bodies"):
        for frame in (0, 1, 3, 4):
            Run(tmp_path / "run").frame_file(kind, frame).unlink()
    results = Results(Run(tmp_path / "run"))
    assert results.frames == [2, 5]
    assert [results.place(f) for f in results.frames] == [2, 5]
