"""The rules that keep the layout livable, checked on the sources."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter

from tests.arrows import PACKAGES, ROOT, arrows, circle, sources

BASE = {"errors", "progress", "reading", "settings", "scheduling"}
VALUES = BASE | {"model"}
ROOMS: dict[str, set[str]] = {
    # without anything of the subject
    "errors": set(),
    "progress": set(),
    "reading": {"errors"},
    "settings": {"errors", "reading"},
    "scheduling": {"progress"},
    "version": set(),
    "kernel_cache": set(),
    "kernels_ahead": set(),
    "source_digest": {"kernel_cache"},
    # nouns, then the one room that reads and writes them
    "model": BASE,
    "files": VALUES | {"source_digest", "version"},
    # from images to geometry
    "calibration": VALUES | {"files"},
    "silhouettes": VALUES | {"carving"},
    "carving": VALUES,
    "matching": VALUES,
    "dense": VALUES | {"matching"},
    # from geometry to motion paths
    "trajectories": VALUES,
    "patches": VALUES | {"carving", "matching", "trajectories"},
    "nodes": VALUES,
    "keypoints": VALUES | {"files", "trajectories"},
    # from motion paths or points to bodies, joints, and the subject's model
    "segmentation": VALUES,
    "bodies": VALUES | {"trajectories"},
    "skeleton": VALUES | {"bodies", "segmentation"},
    # the default method on arrays
    "motion": VALUES | {"bodies", "nodes", "skeleton", "trajectories"},
    "subject": VALUES | {"bodies", "files", "skeleton", "trajectories"},
    "outline_refinement": VALUES | {"bodies", "motion", "skeleton", "subject"},
    # out of the house
    "naming": VALUES,
    "angles": VALUES | {"naming", "skeleton"},
    "export": VALUES | {"angles", "files", "naming", "skeleton", "subject", "version"},
    "evaluation": VALUES | {"carving", "files", "silhouettes", "export", "skeleton", "subject"},
    "inspection": VALUES | {"dense", "files", "export", "evaluation", "subject"},
}
# names of version 0.1.0, which are to go
ROOMS["cameras"] = ROOMS["geometry"] = {"files", "model"}
ROOMS["config"] = set(ROOMS)
ROOMS["pipeline"] = set(ROOMS)
ROOMS["geomocap"] = set(ROOMS)
ROOMS["data_tools"] = VALUES | {"files", "silhouettes"}
ROOMS["viz"] = VALUES | {"files", "calibration", "keypoints", "trajectories", "dense", "matching"}
ROOMS["viz"] |= {"angles", "export", "evaluation", "inspection", "subject"}
ROOMS["cli"] = set(ROOMS)
ROOMS["__main__"] = {"cli"}

KNOWN_ARROWS: set[tuple[str, str]] = {("data_tools", "geomocap"), ("viz", "geomocap")}
KNOWN_LONG: set[str] = set()

WHERE_POINTS_COME_FROM = {"geomocap.model.frame_geometry", "geomocap.model.rig", "open3d", "cv2", "pycolmap"}
NOT_IN_THE_LIBRARY = {"typer", "rich", "dask", "distributed", "viser", "matplotlib", "jinja2", "pytest"}
SOURCES = sources()


def test_packages_import_only_what_the_table_allows():
    wrong = {
        pair: modules
        for pair, modules in arrows(SOURCES).items()
        if pair[1] not in ROOMS[pair[0]] and pair not in KNOWN_ARROWS
    }
    assert not wrong


def test_known_exceptions_are_still_there():
    outside = {pair for pair in arrows(SOURCES) if pair[1] not in ROOMS[pair[0]]}
    assert outside >= KNOWN_ARROWS, "take those that are gone off the list"


def test_arrows_make_no_circle():
    assert circle({(room, other) for room, allowed in ROOMS.items() for other in allowed}) == []
    assert circle(set(arrows(SOURCES)) - KNOWN_ARROWS) == []
    assert circle({("a", "b"), ("b", "c"), ("c", "a")}), "a circle is found where there is one"


def test_bodies_are_found_from_points_and_paths_whatever_their_source():
    for source in SOURCES:
        if source.room in ("segmentation", "bodies"):
            assert not source.imports & WHERE_POINTS_COME_FROM, source.name


def test_library_imports_neither_the_command_line_nor_pictures():
    for source in SOURCES:
        outside = {name.split(".")[0] for name in source.imports}
        if source.room in ("data_tools", "viz"):
            assert not outside & {"typer", "rich", "pytest"}, source.name
        elif source.room not in ("cli", "__main__"):
            assert not outside & NOT_IN_THE_LIBRARY, source.name


def test_importing_the_library_loads_no_command_line():
    code = (
        "import sys, geomocap.pipeline, geomocap.segmentation.m3, geomocap.carving.frames\n"
        "print([m for m in ('typer', 'rich', 'distributed', 'viser', 'viz', 'data_tools') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout.strip() == "[]"


def test_modules_and_classes_have_names_of_their_own():
    stems = [source.file.stem for source in SOURCES]
    assert _twice(stems) <= {"__init__", "__main__"}
    assert not _twice(name for source in SOURCES for name in source.classes)


def test_nouns_know_no_files_and_pictures_run_no_stage():
    for folder, barred in (("geomocap/model", "geomocap.files"), ("viz", "geomocap.pipeline")):
        for file in (ROOT / folder).rglob("*.py"):
            assert barred not in file.read_text(), f"{file} imports {barred}"


def test_results_are_opened_through_their_readers():
    for folder in ("geomocap", "viz"):
        for file in (ROOT / folder).rglob("*.py"):
            if file.parent != ROOT / "geomocap" / "files":
                text = file.read_text()
                assert "np.load(" not in text and ".read_npz(" not in text and ".write_npz(" not in text, file


def test_modules_have_names_that_say_something_and_stay_short():
    for source in SOURCES:
        assert source.file.stem not in {"utils", "util", "helpers", "common", "misc"}, source.name
        limit = 500 if "kernel" in source.file.stem else 400
        lines = len(source.file.read_text().splitlines())
        assert lines <= limit or source.name in KNOWN_LONG, f"{source.name} has {lines} lines, more than {limit}"


def test_every_package_is_looked_at():
    assert {source.name.split(".")[0] for source in SOURCES} == set(PACKAGES)


def _twice(names) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}
