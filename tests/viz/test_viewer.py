"""The viewer: what it opens and tells, names by a click, who may talk to it, and the page in a real browser."""

from __future__ import annotations

import http.client
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from geomocap.errors import GeomocapError
from geomocap.export.export_errors import MissingPackageError, MotionError
from geomocap.export.names import Names
from geomocap.export.run_export import export_run
from geomocap.export.skinned_mesh import SkinnedMesh, bone_mesh
from geomocap.files.run import Run
from tests.viz.chromium import chromium
from tests.viz.conftest import LIMBS, Made
from viz.run_contents import Results
from viz.shown_names import names_of, rename
from viz.view_content import Content, of_run, open_content
from viz.view_panel import Chosen, describe
from viz.view_shapes import body_pieces, quaternion
from viz.viewer import Viewer

FOREARM = [limb[0] for limb in LIMBS].index("forearm_l")


@pytest.fixture
def run(made: Made, tmp_path: Path) -> Run:
    """A run that a test may write to."""
    return Run(shutil.copytree(made.run.path, tmp_path / "run"))


# --- what it opens ---


def test_runs_have_bodies_joints_cameras_and_points(made):
    content = of_run(Results(made.run, made.capture))
    assert content.motion is not None and content.mesh is not None and content.n_frames == 6
    assert sorted(content.motion.bodies.tolist()) == list(range(10))
    node = content.motion.bodies.tolist().index(FOREARM)
    joint = made.figure.joints[:, FOREARM]
    np.testing.assert_allclose(content.posture[1][:, node], joint, atol=1e-5)
    assert len(content.points(2).points) > 1000
    assert content.picture("cam1", 3, 80).shape == (60, 80, 3)
    ends = content.bone_ends(4)
    assert ends.shape == (len(content.bones), 2, 3) and np.isfinite(ends).all()


def test_captures_calibrations_scans_and_motion_files_open(made, run, tmp_path):
    capture = open_content(made.capture.path)
    assert capture.rig is not None and capture.n_frames == 6 and len(capture.stage.points)
    calibration = open_content(made.capture.path / "sparse")
    assert calibration.rig is not None and calibration.picture is None
    export_run(run, ["trc", "bvh"])
    trc, bvh = open_content(run.path / "motion.trc"), open_content(run.path / "motion.bvh")
    assert trc.markers is not None and trc.up == "y" and trc.n_frames == 6
    assert bvh.motion is not None and bvh.bone_ends(3).shape[1:] == (2, 3) and len(bvh.stage.points)
    scans = tmp_path / "scans"
    scans.mkdir()
    for t in range(3):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(made.figure.points(t, 100)[0]))
        o3d.io.write_point_cloud(str(scans / f"{t:03d}.ply"), cloud)
    found = open_content(scans)
    assert found.n_frames == 3 and len(found.points(1).points) == 1000


@pytest.mark.parametrize("name", ["nothing", "motion.glb", "empty"])
def test_what_can_not_be_shown_is_told_in_one_line(name, tmp_path):
    (tmp_path / "motion.glb").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    with pytest.raises(GeomocapError, match=name) as told:
        open_content(tmp_path / name)
    assert "\n" not in str(told.value)


# --- what it tells ---


def test_pieces_make_the_whole_surface_in_every_pose(made):
    content = of_run(Results(made.run))
    motion = content.motion
    mesh = bone_mesh(motion)
    rng = np.random.default_rng(1)
    nodes = rng.integers(0, motion.n_nodes, mesh.nodes.shape)
    weights = rng.dirichlet(np.ones(4), len(nodes))
    mesh = SkinnedMesh(mesh.vertices, mesh.normals, mesh.triangles, mesh.colors, nodes, weights)
    R, p = content.posture
    posed = mesh.posed(motion)[5]
    corners = 0
    for _, piece in body_pieces(mesh, motion.n_nodes):
        local = np.einsum("kji,vkj->vki", R[0, piece.bones], piece.vertices[:, None] - p[0, piece.bones])
        carried = np.einsum("kij,vkj->vki", R[5, piece.bones], local) + p[5, piece.bones]
        found = np.einsum("vk,vki->vi", piece.weights, carried)
        expected = {tuple(v) for v in np.round(posed, 5).tolist()}
        assert {tuple(v) for v in np.round(found, 5).tolist()} <= expected
        corners += piece.faces.size
    assert corners == mesh.triangles.size
    turn = quaternion(R[5])
    assert turn.shape == (motion.n_nodes, 4) and quaternion(np.eye(3)).tolist() == [1, 0, 0, 0]


def test_what_is_chosen_is_told_with_its_angle_and_confidence(made, run):
    run.write_npz("diagnostics.npz", body_confidence=np.linspace(0.5, 0.95, 10))
    (run.path / "names.toml").write_text('[joints]\n"<b>_elbow*" = 3\n')
    content = of_run(Results(run))
    node = content.motion.joints.tolist().index(3)
    name, words = describe(content, Chosen(0, "joint", node), 5 / 30)
    child = int(content.motion.bodies[node])
    parent = LIMBS[child][1]
    turn = made.figure.rotations[:, parent].swapaxes(1, 2) @ made.figure.rotations[:, child]
    angle = np.degrees(np.arccos((np.trace(turn[0].T @ turn[5]) - 1) / 2))
    assert name == "<b>_elbow*" and "<b>" not in words and r"\<b\>\_elbow\*" in words
    assert f"turned by {angle:.1f}°" in words and f"confidence {0.5 + 0.05 * child:.0%}" in words
    assert f"turn about its axis {angle:.1f}°" in words.replace("-", "")


def test_all_of_a_run_can_be_drawn(made, run):
    points, body = made.figure.points(0, 30)
    places = np.repeat(points[:, None], 6, axis=1)
    places[7] = np.nan
    run.write_npz("diagnostics.npz", sample_positions=places, sample_body=body)
    content = of_run(Results(run, made.capture))
    assert content.followed is not None and content.followed.places.shape == (300, 6, 3)
    assert content.ellipsoids is not None and len(content.ellipsoids) == 20
    with served(content) as viewer:
        for layer in viewer.panel._shows.values():
            layer.value = True
        viewer.draw()
        for name in ("followed", "ellipsoids", "points", "bones"):
            assert viewer.server.scene.get_handle_by_name(f"/0/{name}") is not None, name
        assert len(viewer.server.scene.get_handle_by_name("/0/followed").points) == 299
        for layer in viewer.panel._shows.values():
            layer.value = False
        viewer.draw()
        assert viewer.server.scene.get_handle_by_name("/0/ellipsoids") is None


# --- names ---


def test_renaming_writes_what_the_motion_files_read(run):
    results = Results(run)
    assert rename(results, "body", 1, "head") == run.path / "names.toml"
    rename(results, "joint", 0, "neck")
    rename(results, "body", 0, "torso")
    names = Names.read(run.path / "names.toml")
    assert dict(names.bodies) == {0: "torso", 1: "head"} and dict(names.joints) == {0: "neck"}
    rename(results, "body", 0, "")
    assert dict(Names.read(run.path / "names.toml").bodies) == {1: "head"}
    assert "head" in of_run(Results(run)).motion.names
    before = (run.path / "names.toml").read_bytes()
    for kind, number, bad in (("body", 2, "head"), ("body", 2, "a b"), ("body", 99, "far"), ("joint", 3, "../x")):
        with pytest.raises(MotionError):
            rename(results, kind, number, bad)
    assert (run.path / "names.toml").read_bytes() == before


def test_found_names_stand_where_the_user_gave_none(run):
    (run.path / "names_found.toml").write_text('"chest" = 0  # 0.90\n"skull" = 1  # 0.80\n\n[joints]\n"neck" = 0\n')
    rename(Results(run), "body", 4, "chest")
    names = names_of(Results(run))
    assert dict(names.bodies) == {1: "skull", 4: "chest"} and dict(names.joints) == {0: "neck"}
    assert "skull" not in (run.path / "names.toml").read_text()


# --- who may talk to it ---


@contextmanager
def served(*contents: Content) -> Iterator[Viewer]:
    pytest.importorskip("viser")
    viewer = Viewer(contents, port=18_400)
    going = threading.Event()
    going.set()
    thread = threading.Thread(target=viewer.serve, args=(going.is_set,))
    thread.start()
    try:
        yield viewer
    finally:
        going.clear()
        thread.join(30)


def test_the_server_answers_its_own_page_only(made):
    with served(of_run(Results(made.run))) as viewer:
        port = viewer.server.get_port()

        def status(**headers: str) -> int:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
            connection.putrequest("GET", "/", skip_host=True)
            for name, value in {"Host": f"127.0.0.1:{port}", **headers}.items():
                connection.putheader(name.replace("_", "-"), value)
            connection.endheaders()
            found = connection.getresponse().status
            connection.close()
            return found

        socket = {
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec_WebSocket_Version": "13",
            "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
        }
        assert status() == 200
        assert status(Origin=f"http://127.0.0.1:{port}", **socket) == 101
        assert status(Origin="http://evil.example", **socket) == 403
        assert status(Origin="http://evil.example") == 403
        assert status(Host="evil.example") == 403


# --- a recording for Rerun ---


def test_recordings_for_rerun_hold_every_frame(made, tmp_path):
    pytest.importorskip("rerun", reason="Rerun recordings need the package rerun-sdk")
    from viz.rerun_recording import write_recording

    one, six = tmp_path / "one.rrd", tmp_path / "six.rrd"
    content = of_run(Results(made.run, made.capture))
    write_recording(six, [content])
    write_recording(one, [replace(content, n_frames=1)])
    assert one.read_bytes()[:3] == six.read_bytes()[:3] == b"RRF"
    assert six.stat().st_size > 3 * one.stat().st_size
    assert sorted(f.name for f in tmp_path.glob("*.rrd")) == ["one.rrd", "six.rrd"]


def test_without_rerun_the_line_says_what_to_install(made, tmp_path, monkeypatch):
    from viz.rerun_recording import write_recording

    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingPackageError, match=r"geomocap\[rerun\]"):
        write_recording(tmp_path / "x.rrd", [])


# --- the page in a browser ---


def test_two_runs_play_side_by_side_and_bodies_are_renamed_by_a_click(made, run):
    contents = of_run(Results(run, made.capture)), of_run(Results(made.run))
    with served(*contents) as viewer, chromium() as page:
        page.show(1300, 650)
        page.open(viewer.url + "/")
        _until(lambda: viewer.server.get_clients())
        client = next(iter(viewer.server.get_clients().values()))
        _until(lambda: client.camera.update_timestamp > 0)
        box, middle = page.box("canvas"), contents[0].posture[1][0][1:].mean(axis=0)

        def places() -> list[tuple[float, float]]:
            return [_pixel(client, middle + offset, box) for offset in viewer._offsets]

        def drawn() -> bool:
            picture = page.pixels().astype(int)
            around = [picture[int(y) - 8 : int(y) + 8, int(x) - 8 : int(x) + 8] for x, y in places()]
            return all(part.size > 0 and np.ptp(part, axis=2).max() > 50 for part in around)

        _until(drawn)  # both of them
        for _ in range(6):  # drawing in software takes its time: a click may come before there is something to hit
            page.click(*places()[0])
            if _soon(lambda: viewer.chosen is not None, 10):
                break
        assert viewer.chosen is not None and viewer.chosen.content == 0
        viewer.choose(Chosen(0, "body", 1))
        viewer.rename("my_head")
        assert "my_head" in (run.path / "names.toml").read_text()
        page.wait("document.body.textContent.includes('my_head') || document.body.textContent.includes('my\\\\_head')")

        viewer.panel._toggle()
        assert _soon(lambda: viewer.panel.frame > 1)
        viewer.panel._toggle()
        assert not [c for c in page.complaints if "THREE." not in c]  # viser's own library tells of its versions


def _pixel(client, point: np.ndarray, box: tuple[float, float, float, float]) -> tuple[float, float]:
    """Where the page shows a world point."""
    import viser.transforms

    camera = client.camera
    x, y, z = viser.transforms.SO3(camera.wxyz).as_matrix().T @ (point - camera.position)
    focal = box[3] / 2 / np.tan(camera.fov / 2)
    return float(box[0] + box[2] / 2 + focal * x / z), float(box[1] + box[3] / 2 + focal * y / z)


def _soon(fulfilled, seconds: float = 3.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if fulfilled():
            return True
        time.sleep(0.05)
    return False


def _until(fulfilled) -> None:
    assert _soon(fulfilled, 60), "the page didn't follow"
