"""The key-point editor: what it shows of a run, the page without a browser, and the page in a real one."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from geomocap.errors import GeomocapError, SettingsError
from geomocap.export.export_errors import MissingPackageError
from geomocap.files.results import read_followed
from geomocap.keypoints.keypoint_following import KeyPointPaths, Measured
from geomocap.keypoints.keypoint_regions import KeyPoint, KeyPointFile, read_keypoints, write_keypoints
from geomocap.pipeline.keypoint_stage import keypoints
from tests.viz.conftest import Figure, Made, make
from viz.keypoint_editor import KeyPointEditor
from viz.keypoint_marks import BRIDGED, MEASURED, Marks, marked
from viz.keypoint_scene import Subject, marks_of, timeline
from viz.keypoint_session import Follower, Session
from viz.run_contents import Results

FRAMES = 6
HEAD, KNEE = 1, 7  # bodies of the figure


def surface_tracks(figure: Figure) -> np.ndarray:
    """Points of the figure's surface that stay with their bodies, (N, T, 3)."""
    points, body = figure.points(0, 300)
    local = np.einsum("nji,nj->ni", figure.rotations[0, body], points - figure.joints[0, body])
    return np.einsum("tnij,nj->nti", figure.rotations[:, body], local) + figure.joints[:, body].transpose(1, 0, 2)


@pytest.fixture
def scene(tmp_path: Path) -> Made:
    """A run with tracks that a test may write to."""
    made = make(tmp_path, FRAMES)
    made.run.write_npz("tracks.npz", positions=surface_tracks(made.figure))
    return made


def subject_of(made: Made) -> Subject:
    return Subject(Results(made.run, made.capture), read_followed(made.run).positions, 30.0)


# --- what is shown ---


def test_surface_is_the_volume_and_is_thinned_evenly(scene):
    subject = subject_of(scene)
    surface = subject.surface(2)
    assert surface.spacing == 0.015 and len(surface.points) > 5000
    thin = surface.thinned(1000)
    assert len(thin.points) == len(thin.colors) == 1000 and thin.spacing > surface.spacing
    np.testing.assert_array_equal(thin.points, surface.thinned(1000).points)
    assert np.ptp(thin.points, axis=0) == pytest.approx(np.ptp(surface.points, axis=0), rel=0.1)
    assert surface.shaded().colors.shape == surface.colors.shape
    shutil.rmtree(scene.run.path / "voxels")
    assert subject_of(scene).surface(2).points.shape == (3000, 3)  # the trajectories, where there is no volume


def test_trails_end_where_the_points_are_and_show_speed_and_direction(scene):
    tracks = np.full((2, 8, 3), np.nan)
    tracks[0] = np.arange(8)[:, None] * [0.1, 0, 0]
    tracks[1, :5] = np.arange(5)[:, None] * [0, 0.01, 0]
    subject = Subject(Results(scene.run), tracks, 10.0)
    segments, colors = subject.trails(7, "direction")
    assert len(segments) == 6 and segments[-1, 1] == pytest.approx(tracks[0, 7])  # the other one has ended
    assert (colors == [255, 128, 128]).all()
    segments, colors = subject.trails(0, "speed")  # the first frame shows what comes
    assert len(segments) == 6 + 4 and colors[0].sum() > colors[-1].sum()


def test_timeline_says_what_is_known_and_escapes_names():
    positions = np.zeros((10, 2, 3))
    positions[4:, 0] = np.nan
    bridged = np.zeros((10, 2), bool)
    bridged[2:4, 0] = True
    marks = Marks(("<b>", "knee"), positions, np.full(2, 0.03), bridged, np.zeros((0, 2), int), "knee")
    html = timeline(marks, 3)
    assert "<b>" not in html and "&lt;b&gt;" in html
    widths = [float(w) for w in re.findall(r'width="([\d.]+)" height="1" fill="#(?!222831)', html)]
    assert widths == [2, 2, 6, 10]
    assert timeline(Marks((), np.zeros((10, 0, 3)), np.zeros(0), np.zeros((10, 0), bool), marks.links), 0) == ""


def test_marks_lie_where_the_camera_sees_them(scene):
    head = scene.figure.ends[:, HEAD]
    marks = Marks(("head",), head[:, None], np.array([0.05]), np.zeros((FRAMES, 1), bool), np.zeros((0, 2), int))
    camera = scene.rig.select(["cam1"])
    x, y = camera.project(head[3][None])[0, 0]
    drawn = marked(np.zeros((120, 160, 3), np.uint8), camera, marks, 3)
    assert tuple(drawn[int(y), int(x)]) == MEASURED
    bridged = Marks(marks.names, marks.positions, marks.radius, ~marks.bridged, marks.links)
    assert tuple(marked(np.zeros((120, 160, 3), np.uint8), camera, bridged, 3)[int(y), int(x)]) == BRIDGED
    large = marked(np.zeros((240, 320, 3), np.uint8), camera, marks, 3)
    assert tuple(large[int(2 * y), int(2 * x)]) == MEASURED


def test_marks_know_links_by_their_places():
    points = tuple(KeyPoint(name=n, center=(0, 0, 0)) for n in "abc")
    file = KeyPointFile(keypoint=points, links=(("c", "a"),))
    nothing = KeyPointPaths(np.zeros((4, 3, 3)), np.zeros((4, 3), bool), np.zeros((4, 3), int), np.zeros((4, 3)))
    assert marks_of(file, nothing, "b").links.tolist() == [[2, 0]]


# --- the page without a browser ---


@contextmanager
def served(made: Made, save: Callable[[KeyPointFile], str] | None = None) -> Iterator[KeyPointEditor]:
    """Serve the editor from a thread, on a free port."""
    pytest.importorskip("viser", reason="the key-point editor needs viser (extra editor)")
    file = made.run.path / "keypoints.toml"

    def write(wanted: KeyPointFile) -> str:
        write_keypoints(file, wanted)
        keypoints(made.run, wanted)
        return "Saved keypoints.toml."

    begun = read_keypoints(file) if file.exists() else KeyPointFile()
    follow = Follower(Measured.of(read_followed(made.run)))
    editor = KeyPointEditor(subject_of(made), follow, Session.open(begun), save or write, port=18400)
    stop = threading.Event()
    thread = threading.Thread(target=editor.serve, args=(lambda: not stop.is_set(),))
    thread.start()
    try:
        yield editor
    finally:
        stop.set()
        thread.join()


def ray_to(editor: KeyPointEditor, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    eye = editor.server.initial_camera.position
    return eye, point - eye


def test_clicks_place_and_choose_and_edits_show(scene):
    head = scene.figure.ends[0, HEAD]
    with served(scene) as editor:
        editor._click(*ray_to(editor, head))
        assert editor.session.file.names == ["point 1"]
        assert np.linalg.norm(np.array(editor.session.point.center) - head) < 0.13  # on the head
        editor._click(*ray_to(editor, scene.figure.ends[0, KNEE]))
        editor._click(*ray_to(editor, np.array(editor.session.file.keypoint[0].center)))
        assert editor.session.chosen == "point 1" and len(editor.session.file.names) == 2
        editor._click(*ray_to(editor, head + np.array([0, 0, 1.0])))  # beside the subject
        assert len(editor.session.file.names) == 2
        editor._show_frame(4)
        place = editor.follow(editor.session.file).positions[0, 0]
        editor._drag("start", place)
        for step in (0.01, 0.02, 0.03):
            editor._drag("update", place + np.array([0, 0, step]))
        editor._drag("end", place + np.array([0, 0, 0.03]))
        assert len(editor.session.past) == 3  # one step for the whole drag
        assert editor.session.point.center == pytest.approx(place + np.array([0, 0, 0.03]))
        editor._edit(lambda s: s.rename("point 1", "point 2"))
        assert "point 2 already" in editor.panel._status.content
        editor._edit(lambda s: s.delete("point 1"))
        editor._edit(lambda s: s.delete("point 2"))
        assert editor.session.point is None and not editor._handles.visible
        assert editor.url.startswith("http://127.0.0.1:")


def test_what_cannot_be_saved_is_said(scene):
    def refuse(file: KeyPointFile) -> str:
        raise SettingsError("no room")

    with served(scene, refuse) as editor:
        editor._click(*ray_to(editor, scene.figure.ends[0, HEAD]))
        editor._save()
        assert "no room" in editor.panel._status.content and editor.session.is_changed


def test_without_viser_one_line_names_the_extra(scene, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    follow = Follower(Measured.of(read_followed(scene.run)))
    with pytest.raises(MissingPackageError, match=r"need the package viser.*geomocap\[editor\]") as error:
        KeyPointEditor(subject_of(scene), follow, Session(), lambda file: "")
    assert isinstance(error.value, GeomocapError)


# --- the page in a browser ---


@contextmanager
def browser_page() -> Iterator[Any]:
    """Open a page of a headless browser that draws in software."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="driving a browser needs the package playwright")
    found = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
    if found is None:
        pytest.skip("no chromium or chrome is installed")
    flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=flags)
        try:
            yield browser.new_page(viewport={"width": 1300, "height": 900})
        finally:
            browser.close()


class User:
    """Somebody who uses the page, and waits until what was asked for has happened."""

    def __init__(self, page: Any, editor: KeyPointEditor) -> None:
        self.page, self.editor = page, editor
        page.goto(editor.url)
        self.wait(lambda: editor.server.get_clients())
        self.client = next(iter(editor.server.get_clients().values()))
        self.wait(lambda: self.client.camera.update_timestamp > 0)
        self.picture()

    def wait(self, fulfilled: Callable[[], object]) -> None:
        for _ in range(400):
            if fulfilled():
                return
            self.page.wait_for_timeout(50)
        raise AssertionError("the page didn't follow")

    def picture(self) -> np.ndarray:
        """What the scene shows; comes back when it is drawn."""
        return self.client.get_render(450, 450, timeout=60)

    def at(self, point: np.ndarray) -> tuple[float, float]:
        """Where the page shows a world point."""
        import viser.transforms

        camera, box = self.client.camera, self.page.locator("canvas").first.bounding_box()
        x, y, z = viser.transforms.SO3(camera.wxyz).as_matrix().T @ (point - camera.position)
        focal = box["height"] / 2 / np.tan(camera.fov / 2)
        return box["x"] + box["width"] / 2 + focal * x / z, box["y"] + box["height"] / 2 + focal * y / z

    def field(self, label: str) -> Any:
        return self.page.locator(f'xpath=//label[normalize-space(text())="{label}"]/following::input[1]')

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button, exact=True).click()

    @property
    def names(self) -> list[str]:
        return self.editor.session.file.names


@pytest.mark.filterwarnings("default")  # those of the browser's driver are not ours
def test_place_move_rename_delete_undo_save_reload(scene):
    toml = scene.run.path / "keypoints.toml"
    head, shin = scene.figure.ends[0, HEAD], scene.figure.ends[0, KNEE]
    with browser_page() as page:
        with served(scene) as editor:
            user = User(page, editor)
            for point, expected in ((head, 1), (shin, 2)):
                page.mouse.click(*user.at(point))
                user.wait(lambda expected=expected: len(user.names) == expected)
            assert user.picture().std() > 10

            place = np.array(editor.session.point.center)
            tip = place + editor.subject.stage.up * 0.5 * editor._handles.scale
            user.wait(lambda: np.allclose(editor._handles.position, place))
            user.picture()
            x, y = user.at(tip)
            page.mouse.move(x, y)
            page.mouse.down()
            for step in range(1, 9):
                page.mouse.move(x, y - 4 * step)
            page.mouse.up()
            user.wait(lambda: editor.session.point.center[2] > place[2] + 0.02)
            user.wait(lambda: editor._dragged is None)
            assert len(user.names) == 2 and len(editor.session.past) == 3
            np.testing.assert_allclose(editor.session.point.center[:2], place[:2], atol=1e-6)  # along its arrow

            user.field("Name").fill("shin")
            user.wait(lambda: user.names == ["point 1", "shin"])
            user.press("Delete")
            user.wait(lambda: user.names == ["point 1"])
            user.press("Undo")
            user.wait(lambda: user.names == ["point 1", "shin"])
            user.picture()  # the handles have gone from there
            page.mouse.click(*user.at(np.array(editor.session.file.keypoint[0].center)))
            user.wait(lambda: editor.session.chosen == "point 1")
            page.keyboard.press("Control+z")
            user.wait(lambda: "shin" not in user.names)
            user.press("Redo")
            user.wait(lambda: "shin" in user.names)
            user.press("Save")
            user.wait(lambda: not editor.session.is_changed)
            page.get_by_text("Saved keypoints.toml").wait_for()
            saved = read_keypoints(toml)
            assert saved.names == ["point 1", "shin"]
            assert scene.run.read_npz("keypoints.npz")["names"].tolist() == ["point 1", "shin"]

            user.press("Play")
            user.wait(lambda: editor.panel.frame > 1)
            user.press("Stop")
            page.reload()
            page.get_by_text("shin").first.wait_for()
        with served(scene) as editor:
            user = User(page, editor)
            assert editor.session.file == saved
            page.get_by_text("shin").first.wait_for()
