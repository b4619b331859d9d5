"""Animated files in the viewer: each frame as the file says, whatever moves it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.figure import figure
from data_tools.gltf_reader import load_gltf
from geomocap.export.export_settings import ExportSettings
from geomocap.export.run_export import export_run
from tests.data_tools.gltf_writer import GltfWriter
from tests.viz.chromium import chromium
from tests.viz.test_viewer import _soon, _until, served
from viz.run_contents import Results
from viz.view_animation import LONGEST, of_animation
from viz.view_content import of_run
from viz.view_panel import Chosen, describe


def growing_parts(path: Path) -> Path:
    """Two triangles on two roots of the same name, one of which grows."""
    gltf = GltfWriter()
    for _ in range(2):
        place = gltf.accessor([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        gltf.document["meshes"].append({"primitives": [{"attributes": {"POSITION": place}}]})
    gltf.document["nodes"] = [{"mesh": 0, "name": "part"}, {"mesh": 1, "name": "part"}]
    gltf.document["scenes"][0]["nodes"] = [0, 1]
    gltf.animate(0, "scale", [0.0, 0.5, 1.0], [[1, 1, 1], [2, 2, 2], [3, 3, 3]])
    gltf.animate(1, "translation", [0.0, 1.0], [[0, 0, 0], [0, 2, 0]])
    return gltf.write_glb(path)


def test_our_own_motion_file_shows_what_the_run_shows(made, tmp_path):
    export_run(made.run, ["glb"], ExportSettings(names="none", surface="skin"), folder=tmp_path)
    of_file = of_animation("motion.glb", load_gltf(tmp_path / "motion.glb"))
    of_folder = of_run(Results(made.run))
    assert of_file.n_frames == of_folder.n_frames == 6 and of_file.fps == pytest.approx(of_folder.fps, rel=1e-3)
    assert set(of_folder.motion.names) == set(of_file.motion.names) and not of_file.free
    order = [of_file.motion.names.index(name) for name in of_folder.motion.names]
    turns, places = ([posture[k] for posture in (of_file.posture, of_folder.posture)] for k in (0, 1))
    np.testing.assert_allclose(places[0][:, order], places[1], atol=1e-5)
    since = [R @ R[:1].swapaxes(-1, -2) for R in turns]  # the file's nodes have axes of their own
    np.testing.assert_allclose(since[0][:, order], since[1], atol=1e-5)
    assert of_file.motion.parents[0] == -1 and len(of_file.bones) == len(of_folder.motion.names) - 1
    posed = of_folder.mesh.posed(of_folder.motion)
    for frame in (0, 3, 5):
        low, high = of_file.surface.at(frame).min(axis=0), of_file.surface.at(frame).max(axis=0)
        np.testing.assert_allclose([low, high], [posed[frame].min(axis=0), posed[frame].max(axis=0)], atol=1e-4)
    name, words = describe(of_file, Chosen(0, "body", 3), 0.1)
    assert name == of_file.motion.names[3] and "turned by" in words


def test_parts_that_grow_and_hang_on_nothing_are_shown(tmp_path):
    content = of_animation("parts", load_gltf(growing_parts(tmp_path / "parts.glb")))
    assert content.n_frames == 3 and content.fps == 2
    assert content.motion.names == ("part", "part 2") and content.bones == [] and content.free == {1}
    sizes = [np.ptp(content.surface.at(frame)[:3], axis=0).max() for frame in range(3)]
    np.testing.assert_allclose(sizes, [1, 2, 3], atol=1e-6)
    np.testing.assert_allclose(content.posture[1][:, 1], [[0, 0, 0], [0, 0, 1], [0, 0, 2]], atol=1e-6)
    pieces = content.surface.pieces()
    assert [node for node, _, _ in pieces] == [0, 1] and pieces[1][1].tolist() == [3, 4, 5]
    assert len(content.stage.points)


def test_still_and_endless_animations_have_as_many_frames_as_make_sense():
    subject = figure()
    still = of_animation("still", replace(subject, duration=0.0))
    endless = of_animation("long", replace(subject, duration=1e6, key_rate=1000.0))
    assert still.n_frames == 1 and endless.n_frames == LONGEST and endless.n_frames / endless.fps > 0.99e6


def test_recordings_hold_the_surface(tmp_path):
    pytest.importorskip("rerun", reason="Rerun recordings need the package rerun-sdk")
    from viz.rerun_recording import write_recording

    content = of_animation("parts", load_gltf(growing_parts(tmp_path / "parts.glb")))
    write_recording(tmp_path / "with.rrd", [content])
    write_recording(tmp_path / "without.rrd", [replace(content, surface=None)])
    assert (tmp_path / "with.rrd").stat().st_size > (tmp_path / "without.rrd").stat().st_size


def test_the_surface_moves_in_the_browser(made, tmp_path):
    export_run(made.run, ["glb"], folder=tmp_path)
    content = of_animation("motion.glb", load_gltf(tmp_path / "motion.glb"))
    with served(content) as viewer, chromium() as page:
        page.show(1300, 650)
        page.open(viewer.url + "/")
        _until(lambda: viewer.server.get_clients())
        viewer.panel._surface.value = "solid"
        viewer.panel._shows["skeleton"].value = viewer.panel._shows["trails"].value = False
        viewer.draw()

        def coloured() -> int:
            x, y, width, height = (int(v) for v in page.box("canvas"))
            picture = page.pixels().astype(int)[y : y + height, x + int(0.3 * width) : x + int(0.7 * width)]
            return int((np.ptp(picture, axis=2) > 60).sum())

        assert _soon(lambda: coloured() > 500, 60)
        before = page.pixels()
        viewer.panel.frame = 5
        viewer.draw()
        assert _soon(lambda: (page.pixels() != before).any(axis=2).sum() > 100, 60)
        viewer.panel._surface.value = "off"
        viewer.draw()
        assert _soon(lambda: coloured() < 100, 60)
        assert not [c for c in page.complaints if "THREE." not in c]  # viser's own library tells of its versions
