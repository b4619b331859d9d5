"""The report's moving subject: what the page carries, and the page in a real browser."""

from __future__ import annotations

import base64
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest

from geomocap.export.conventions import GLB
from geomocap.export.run_export import export_run
from geomocap.files.results import read_skeleton
from geomocap.files.run import Run
from tests.viz.chromium import Page, chromium
from tests.viz.conftest import LIMBS, Made, make
from viz.camera_pictures import undistorting_maps
from viz.report import Report, render_html, turning
from viz.run_contents import Results
from viz.scene import stage
from viz.sections import section
from viz.sheets import still
from viz.shown_names import body_names
from viz.turntable import Turntable, glb_of, motion_of, script_json, turntable

HOSTILE = "</script><img/src=x/onerror=alert(1)>"
FRAMES = 6


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A run with followed points, confidences and a name that would like to be mark-up."""
    made = make(tmp_path_factory.mktemp("turntable"), FRAMES)
    points, body = made.figure.points(0, 80)
    local = np.einsum("nji,nj->ni", made.figure.rotations[0, body], points - made.figure.joints[0, body])
    paths = np.einsum("tnij,nj->nti", made.figure.rotations[:, body], local)
    paths += made.figure.joints[:, body].transpose(1, 0, 2)
    paths[3, 2] = np.nan
    sure = np.linspace(0.5, 1, len(LIMBS))
    made.run.write_npz("diagnostics.npz", sample_positions=paths, sample_body=body, body_confidence=sure)
    names = '[bodies]\nskull = 1\n[joints]\n"<i>neck<i>" = 0\n'
    (made.run.path / "names.toml").write_text(names, encoding="utf-8")
    return made


@pytest.fixture(scope="module")
def turns(scene: Made) -> Turntable:
    results = Results(scene.run, scene.capture)
    found = turntable(results, stage(results))
    assert found is not None
    return found


# --- what the page carries ---


def test_scripts_hold_any_text_without_ending():
    text = script_json({"name": HOSTILE, "more": "&\u2028"})
    assert "<" not in text and ">" not in text and "\u2028" not in text
    assert json.loads(text) == {"name": HOSTILE, "more": "&\u2028"}


def test_nodes_are_those_of_the_file_with_the_users_names(scene, turns):
    data = json.loads(turns.data)
    document = pygltflib.GLTF2.load_from_bytes(base64.b64decode(turns.glb))
    names = [document.nodes[n].name for n in document.skins[0].joints]
    assert [n["name"] for n in data["nodes"]] == names and "skull" in names
    head = data["nodes"][names.index("skull")]
    assert head["joint"]["name"] == "<i>neck<i>" and head["confidence"] == pytest.approx(0.5 + 0.5 / 9, abs=1e-3)
    assert [n["parent"] for n in data["nodes"]].count(-1) == 1
    assert data["frames"] == list(range(FRAMES)) and data["fps"] == 30


def test_angles_of_a_joint_are_those_of_the_motion_files(scene, turns):
    exported = export_run(scene.run, ["angles"], folder=scene.run.path / "angles only")
    angles, skeleton = exported.angles, read_skeleton(scene.run)
    data = json.loads(turns.data)
    for j, (parent, child) in enumerate(skeleton.joint_bodies.tolist()):
        node = next(n for n in data["nodes"] if n["joint"] and n["name"] == named_bodies(scene)[child])
        told = {a["name"]: a for a in node["angles"]}
        assert set(told) == {"turn about its axis", "about other axes"}, (j, parent)
        column = angles.of_joint(parent, child)[0]
        assert angles.names[column].endswith("_turn")
        assert told["turn about its axis"]["values"] == pytest.approx(angles.values[:, column], abs=0.006)
        assert (told["turn about its axis"]["std"] is None) == bool(np.isnan(angles.std[:, column]).all())


def named_bodies(scene: Made) -> tuple[str, ...]:
    return body_names(Results(scene.run), read_skeleton(scene.run))


def test_followed_points_come_back_from_their_quantised_places(scene, turns):
    tracks = json.loads(turns.data)["tracks"]
    levels = np.frombuffer(base64.b64decode(tracks["places"]), np.uint16).reshape(FRAMES, tracks["count"], 3)
    places = np.where(levels == 65_535, np.nan, np.array(tracks["low"]) + tracks["step"] * levels)
    paths = scene.run.read_npz("diagnostics.npz")["sample_positions"]
    chosen = np.sort(np.random.default_rng(0).permutation(len(paths))[: tracks["count"]])
    np.testing.assert_allclose(places.swapaxes(0, 1), GLB.points(paths[chosen], "z"), atol=5e-5)


def test_pictures_corners_lie_where_a_camera_without_distortion_sees_them(scene, turns):
    data, rig = json.loads(turns.data), scene.rig
    assert data["pictured"] == list(range(FRAMES)) and [c["name"] for c in data["cameras"]] == list(rig.names)
    for c, told in enumerate(data["cameras"]):
        corners = GLB.world_points(np.array(told["corners"]), "z")
        in_camera = corners @ rig.cam_from_world[c, :, :3].T
        K = rig.cameras[c].calibration_matrix()
        pixels = (in_camera @ K.T)[:, :2] / in_camera[:, 2:]
        w, h = rig.sizes[c]
        np.testing.assert_allclose(pixels, [[0, 0], [w, 0], [w, h], [0, h]], atol=0.05)
        assert len(told["pictures"]) == FRAMES and all(p.startswith("data:image/webp") for p in told["pictures"])


def test_small_pictures_are_free_of_distortion(scene):
    own = scene.rig.cameras[1]
    x, y = undistorting_maps(scene.rig, 1, (80, 60))
    row, column = 8, 72
    straight = 2 * (np.array([column, row]) + 0.5)  # of a picture of half the size
    ray = np.linalg.inv(own.calibration_matrix()) @ [*straight, 1]
    bent = np.asarray(own.img_from_cam(ray[None]))[0]
    np.testing.assert_allclose([2 * (x[row, column] + 0.5), 2 * (y[row, column] + 0.5)], bent, atol=1e-3)
    assert np.abs(bent - straight).max() > 0.5  # else there was nothing to see


def test_a_file_of_another_skeleton_is_not_shown(scene, tmp_path):
    results = Results(scene.run, scene.capture)
    skeleton = results.skeleton
    assert skeleton is not None
    motion = motion_of(results, skeleton)
    run = Run(shutil.copytree(scene.run.path, tmp_path / "run"))
    (run.path / "model.npz").write_bytes(b"")
    good = glb_of(results, motion)
    (run.path / "motion.glb").write_bytes(good + b"\0\0\0\0")  # recognisable
    assert glb_of(Results(run), motion) == good + b"\0\0\0\0"
    document = pygltflib.GLTF2.load_from_bytes(good)
    document.nodes[document.skins[0].joints[2]].translation = [0.0, 0.3, 0.0]
    (run.path / "motion.glb").write_bytes(b"".join(document.save_to_bytes()))
    (run.path / "model.npz").unlink()
    assert glb_of(Results(run), motion) == good


def test_without_a_skeleton_nothing_turns(scene, tmp_path):
    run = Run(shutil.copytree(scene.run.path, tmp_path / "run"))
    (run.path / "skeleton.npz").unlink()
    results = Results(run)
    assert turntable(results, stage(results)) is None


# --- the page in a browser ---


@pytest.fixture(scope="module")
def page_file(scene: Made, turns: Turntable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    results = Results(scene.run, scene.capture)
    picture = still(results, stage(results), 3, (480, 300))
    parts = (section("Result", [turning(picture, "The subject")]),)
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render_html(Report(HOSTILE, HOSTILE, sections=parts, turntable=turns)), encoding="utf-8")
    return path


def ready(page: Page, file: Path) -> None:
    page.open(file.as_uri())
    page.wait("document.querySelector('#turntable.alive') && document.querySelector('#turntable').dataset.frame")
    shown(page)


def shown(page: Page) -> np.ndarray:
    """What the canvas shows, once it is drawn."""
    page.run("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(r))))")
    return page.pixels("#turntable canvas").astype(int)


def colorful(image: np.ndarray) -> int:
    """Pixels with a strong colour, as bodies have them and stage and floor don't."""
    return int((np.ptp(image, axis=2) > 60).sum())


def press(page: Page, label: str) -> None:
    script = "[...document.querySelectorAll('#turntable button')].find(b => b.textContent === {})"
    page.run(script.format(json.dumps(label)) + ".click()")


def change(page: Page, label: str, value: Any) -> None:
    script = "(s => {{ s.value = {}; s.dispatchEvent(new Event({})); }})(document.querySelector('[aria-label=\"{}\"]'))"
    event = "input" if label == "Time" else "change"
    page.run(script.format(json.dumps(value), json.dumps(event), label))


def test_the_subject_is_drawn_turned_played_and_taken_apart(page_file):
    with chromium() as page:
        page.show(1000, 900)
        ready(page, page_file)
        whole = shown(page)
        assert colorful(whole) > 2000
        edges = np.concatenate([whole[:4].reshape(-1, 3), whole[:, :4].reshape(-1, 3)])
        assert np.ptp(edges, axis=1).max() < 40  # the subject is in the picture as a whole

        # layers: what is switched off goes, and comes back
        press(page, "Off")
        bones = shown(page)
        press(page, "Skeleton")
        press(page, "Trails")
        empty = shown(page)
        assert colorful(whole) > colorful(bones) > colorful(empty) == 0
        press(page, "Skeleton")
        press(page, "Trails")
        press(page, "Glass")
        np.testing.assert_array_equal(shown(page), whole)

        # what is clicked is named, as the user calls it
        x, y, w, h = page.box("#turntable canvas")
        strong = np.argwhere(np.ptp(whole, axis=2) > 60)
        row, column = strong[np.abs(strong - strong.mean(axis=0)).sum(axis=1).argmin()].tolist()
        page.click(x + column, y + row)
        page.wait("!document.querySelector('#turntable .card').hidden")
        told = page.run("document.querySelector('#turntable .card').textContent")
        names = {limb[0] for limb in LIMBS} | {"skull"} | {f"body{b:02d}" for b in range(len(LIMBS))}
        assert page.run("document.querySelector('#turntable').dataset.chosen") in names and "confidence" in told
        assert "turn about its axis" in told or "turned0" in told
        page.run("document.querySelector('#turntable .close').click()")
        page.mouse("mouseMoved", x + w / 2, y + h + 20)  # what is pointed at is darker
        np.testing.assert_array_equal(shown(page), whole)

        # time: the slider, then play until it has gone on
        change(page, "Time", str(FRAMES - 1))
        assert np.abs(shown(page) - whole).max() > 60
        assert page.run("document.querySelector('#turntable').dataset.frame") == str(FRAMES - 1)
        change(page, "Time", "0")
        page.run("document.querySelector('[aria-label=Play]').click()")
        page.wait("Number(document.querySelector('#turntable').dataset.frame) > 0")
        page.run("document.querySelector('[aria-label=Stop]').click()")
        change(page, "Time", "0")
        np.testing.assert_array_equal(shown(page), whole)

        # a drag turns it
        page.mouse("mouseMoved", x + w / 2, y + h / 2)
        page.mouse("mousePressed", x + w / 2, y + h / 2, button="left", clickCount=1)
        page.mouse("mouseMoved", x + w / 2 + 200, y + h / 2, button="left", buttons=1)
        page.mouse("mouseReleased", x + w / 2 + 200, y + h / 2, button="left", clickCount=1)
        assert np.abs(shown(page) - whole).max() > 60

        # the cameras, and the subject through one of them: over its picture
        press(page, "Cameras")
        change(page, "Look through a camera", "1")
        for _ in range(40):  # the picture comes when it is decoded
            left, right = (int(w / 2 + sign * 0.5 * h) for sign in (-1, 1))
            wall = shown(page)[int(0.2 * h), left:right].mean(axis=1)
            if wall.max() < 225:
                break
        assert 120 < np.median(wall) < 210 and wall.max() < 225

        assert page.complaints == []
        assert all(a.startswith(("data:", "blob:", page_file.as_uri())) for a in page.fetched)
        assert page.run("document.querySelectorAll('img[onerror], main img[src=x]').length") == 0


def test_telephones_and_dark_rooms(page_file):
    with chromium() as page:
        bright = {}
        for dark in (False, True):
            page.show(390, 844, dark=dark, touch=True)
            ready(page, page_file)
            assert page.run("document.documentElement.scrollWidth") == 390
            _, _, width, height = page.box("#turntable canvas")
            assert width == 390 and 300 < height < 844
            bright[dark] = float(shown(page).mean())
            assert page.run("[...document.querySelectorAll('#turntable button')].every(b => b.offsetHeight >= 24)")
        assert bright[False] > 200 and bright[True] < 70
        assert page.complaints == []


def test_a_picture_stands_where_webgl_is_missing(page_file):
    with chromium("--disable-3d-apis") as page:
        page.show(800, 700)
        page.open(page_file.as_uri())
        page.wait("document.querySelector('#turntable .still').complete")
        assert page.run("document.querySelector('#turntable canvas')") is None
        assert colorful(page.pixels("#turntable .still").astype(int)) > 1000
        assert page.complaints == []
