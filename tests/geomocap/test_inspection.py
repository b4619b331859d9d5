import numpy as np
import pycolmap
import pytest
import trimesh
from cv2 import imwrite

from geomocap.export.run_export import export_run
from geomocap.files.atomic import temporary_beside
from geomocap.files.camera_file import CameraDoubts, write_camera_doubts
from geomocap.files.results import write_warnings
from geomocap.files.rigs import write_rig
from geomocap.files.run import Run
from geomocap.inspection import describe
from geomocap.inspection.describe import InspectionError
from geomocap.model.rig import Rig
from tests.geomocap.articulated import skeleton_arrays
from tests.geomocap.made_truth import flawed_run, write_truth


def facts(path):
    told = describe(path)
    return told, dict(told.facts)


def two_cameras(away=False):
    camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24])
    poses = np.zeros((3, 3, 4))
    for c, angle in enumerate((0, 1.5, 3.0)):
        z = np.array([np.cos(angle), np.sin(angle), 0]) * (-1 if not (away and c == 2) else 1)
        R = np.stack([np.cross([0, 0, -1.0], z), [0, 0, -1], z])
        poses[c, :, :3] = R
        poses[c, :, 3] = -R @ (3 * np.array([np.cos(angle), np.sin(angle), 0.2]))
    return Rig(("a", "b", "c"), (camera,) * 3, poses)


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    for name in "abc":
        (folder / "images" / name).mkdir(parents=True)
        for k in range(3):
            picture = np.broadcast_to(np.arange(64, dtype=np.uint8)[:, None], (48, 64, 3))
            imwrite(str(folder / "images" / name / f"{k:06d}.png"), picture)
    (folder / "capture.toml").write_text('name = "walk"\nfps = 15.0\n')
    return folder


def test_a_capture_without_and_with_calibration(capture):
    told, said = facts(capture)
    assert told.kind == "capture"
    assert said["frames"] == "3 at 15 per second, 0.20 s"
    assert said["cameras"] == "3: a, b, c (images)"
    assert said["image sizes"] == "64×48 (3 cameras)"
    assert len(told.problems) == 1 and told.problems[0].startswith("not calibrated")
    write_rig(capture / "sparse", two_cameras())
    told, said = facts(capture)
    assert told.problems == []
    assert "focal length 60.0 px (56° across)" in said["a"]


def test_two_cameras_that_can_not_be_matched_are_told(capture):
    write_rig(capture / "sparse", two_cameras())
    (capture / "capture.toml").write_text('fps = 15.0\ncameras = ["a", "b"]\n')
    (problem,) = describe(capture).problems
    assert problem.startswith("no two cameras can be matched") and "cloud.groups.greatest_angle" in problem


def test_a_capture_with_problems(capture):
    write_rig(capture / "sparse", two_cameras(away=True))
    (capture / "images" / "b" / "000002.png").write_bytes(b"")
    (capture / "background").mkdir()
    imwrite(str(capture / "background" / "a.png"), np.zeros((48, 64, 3), np.uint8))
    problems = describe(capture).problems
    assert any("000002.png: truncated" in p for p in problems)
    assert any(p.startswith("camera c: looks away") for p in problems)
    assert any(p.startswith("no background picture of b, c") for p in problems)
    (capture / "images" / "c" / "000002.png").unlink()
    assert "unequal numbers of frames" in describe(capture).problems[0]


def test_a_capture_with_files_that_can_not_be_used(capture):
    write_rig(capture / "sparse", two_cameras())
    flat = np.zeros((48, 64), np.uint8)
    for name in "abc":
        for part in (f"images/{name}/000003", f"background/{name}", *(f"masks/{name}/{k:06d}" for k in range(4))):
            (capture / part).parent.mkdir(parents=True, exist_ok=True)
            imwrite(str(capture / f"{part}.png"), flat)
    assert describe(capture).problems == []
    damaged = capture / "images/a/000001.png"
    damaged.write_bytes(damaged.read_bytes()[:-20])
    imwrite(str(capture / "images/b/000002.png"), flat[:20])
    for k in range(4):
        imwrite(str(capture / f"masks/a/{k:06d}.png"), flat[:, :20])
    imwrite(str(capture / "masks/b/000000.png"), flat + 1)
    imwrite(str(capture / "background/c.png"), flat[:10])
    problems = [p.removeprefix(f"{capture}/") for p in describe(capture).problems]
    said = [
        "images/a/000001.png: truncated",
        "images/b/000002.png: 64×20 pixels, but 000000.png is 64×48",
        "background/c.png: 64×10 pixels, but the images of camera c are 64×48",
        *(f"masks/a/{k:06d}.png: 20×48 pixels, but the images of camera a are 64×48" for k in range(3)),
        "masks/a: 1 more file like these",
        "masks/b/000000.png: its values go up to 1 only",
    ]
    assert len(problems) == len(said)
    for problem, start in zip(problems, said, strict=True):
        assert problem.startswith(start)
    (capture / "capture.toml").write_text("fps = 15.0\ntemplate_camera = 'nix'\n")
    assert "there is no camera nix" in describe(capture).problems[0]


def test_a_calibration(tmp_path):
    write_rig(tmp_path / "sparse", two_cameras())
    for path in (tmp_path, tmp_path / "sparse"):
        told, said = facts(path)
        assert told.kind == "calibration"
        assert said["calibration"].startswith("3 cameras, looking at about")
        assert told.problems == []


def test_a_run_with_its_flaws(tmp_path):
    run = flawed_run(tmp_path)
    run.frame_file("cloud", 4).unlink()
    run.begin("tracks", "key", [])
    left = temporary_beside(tmp_path / "motion.bvh")
    left.write_text("")
    told, said = facts(tmp_path)
    assert told.kind == "run"
    assert said["skeleton"] == "4 joints between 5 bodies"
    assert said["bodies"] == "16 frames, 000000 to 000015"
    assert said["tracks"].startswith("20 points in 16 frames")
    assert any("cloud/ lacks 1 frame from 000004 on" in p for p in told.problems)
    assert any("joints lack a position in 1.6 %" in p for p in told.problems)
    assert any("stage tracks isn't finished" in p for p in told.problems)
    assert any(f"{left.name} was left" in p for p in told.problems)
    np.savez(tmp_path / "tracks.npz", velocities=np.zeros(3))
    assert any("tracks.npz: has no array positions" in p for p in describe(tmp_path).problems)


def test_a_truth(tmp_path):
    told, said = facts(write_truth(tmp_path))
    assert told.kind == "truth"
    assert said["bodies that move"] == "4, beginning at trunk, arm, hand, leg"
    assert told.problems == []
    told = describe(write_truth(tmp_path, fps=np.array(-1.0)))
    assert "fps is -1," in told.problems[0]


@pytest.fixture
def motion_files(tmp_path):
    run = Run(tmp_path / "run")
    run.write_npz("skeleton.npz", **skeleton_arrays())
    return export_run(run, ["bvh", "trc", "glb"]).files


def test_motion_files(motion_files):
    for name, path in motion_files.items():
        told, said = facts(path)
        assert told.problems == []
        if name != "glb":
            assert said["frames"] == "20 at 15 per second, 1.33 s"
    assert facts(motion_files["bvh"])[1]["joints"].startswith("7: body00")
    assert facts(motion_files["glb"])[1]["animation motion"] == "20 key frames, 1.27 s"


def test_motion_files_with_problems(motion_files):
    bvh, trc, glb = (motion_files[k] for k in ("bvh", "trc", "glb"))
    trc.write_text(trc.read_text().replace("\tmm\t", "\tm\t"))
    assert any("likely in another unit" in p for p in describe(trc).problems)
    assert any("m/s after frame" in p for p in describe(trc).problems)
    bvh.write_text("HIERARCHY")
    assert "no BVH" in describe(bvh).problems[0]
    data = glb.read_bytes()
    glb.write_bytes(data[:-40])
    assert "it was cut off" in describe(glb).problems[0]
    glb.write_bytes(b"glb")
    assert "no GLB file" in describe(glb).problems[0]


def test_scans(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    for k in range(6):
        np.savez(tmp_path / f"{k}.npz", points=points + 0.1 * k)
    told = describe(tmp_path)
    facts = dict(told.facts)
    assert told.kind == "scans" and facts["frames"] == "6" and facts["points"] == "50 in a frame"
    assert "tracks" in facts["points in common"] and told.problems == []
    np.savez(tmp_path / "1.npz", points=np.append(points, [[np.nan, 0, 0]], axis=0))
    facts = dict(describe(tmp_path).facts)
    assert facts["points"] == "50 to 51 in a frame" and facts["missing points"] == "0.3% (NaN)"
    assert facts["points in common"].startswith("no")
    for k in range(2, 6):
        np.savez(tmp_path / f"{k}.npz", points=np.full((4, 3), np.inf))
    told = describe(tmp_path)
    assert "2.npz: 4 points are infinite" in told.problems[0] and "1 more scan" in told.problems[3]
    (tmp_path / "2.npz").unlink()
    assert "number 2 is missing" in describe(tmp_path).problems[0]
    mesh = trimesh.creation.box()
    mesh.export(tmp_path / "box.ply")
    facts = dict(describe(tmp_path / "box.ply").facts)
    assert facts["meshes"] == "8 vertices, 12 triangles" and "one scan" in facts["motion"]


def test_what_a_segmentation_warns_of_or_refuses_is_told_of_scans(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4, 50, 3))
    flat, line = points * (1, 1, 0), points * (1, 0, 0)
    says = {
        "millimetres": (1000 * points, "which are likely no metres; set scans.scale"),
        "flat": (flat, "and those of 3 more scans lie in a plane"),
        "axes": (line, "all its points lie in a line"),
    }
    for name, (found, text) in says.items():
        np.savez(tmp_path / f"{name}.npz", points=found)
        told = describe(tmp_path / f"{name}.npz")
        assert len(told.problems) == (name == "axes") and text in (told.problems + told.doubts)[0]
        assert "points in common" in dict(told.facts)
    told = describe(tmp_path / "millimetres.npz", metres_per_unit=0.001)
    assert told.problems == told.doubts == [] and dict(told.facts)["box around all"].endswith(" m")


def test_what_was_doubtful_when_a_run_was_made_is_told(tmp_path):
    run = Run(tmp_path / "run")
    run.write_npz("skeleton.npz", **skeleton_arrays())
    run.write_record({"source": {"up": "z"}})
    assert describe(run.path).problems == []
    write_warnings(run, ["the scans are 824 m across"])
    write_camera_doubts(run, CameraDoubts(("cam02",), (), ("camera cam02 is mirrored",)))
    assert describe(run.path).doubts == ["camera cam02 is mirrored", "the scans are 824 m across"]
    assert describe(run.path).problems == []


def test_nothing_known(tmp_path):
    with pytest.raises(InspectionError, match="no such file or folder"):
        describe(tmp_path / "nothing")
    with pytest.raises(InspectionError, match="neither a capture"):
        describe(tmp_path)
    (tmp_path / "a.fbx").write_text("")
    with pytest.raises(InspectionError, match="no known kind of file"):
        describe(tmp_path / "a.fbx")
