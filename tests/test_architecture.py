"""The rules that keep the layout livable, checked on the sources."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter

from tests.arrows import PACKAGES, ROOT, arrows, circle, sources

BASE = {"errors", "progress", "settings", "scheduling"}
VALUES = BASE | {"model"}
ROOMS: dict[str, set[str]] = {
    # without anything of the subject
    "errors": set(),
    "progress": set(),
    "settings": {"errors"},
    "scheduling": {"progress"},
    # nouns, then the one room that reads and writes them
    "model": BASE,
    "files": VALUES,
    # from images to geometry
    "calibration": VALUES | {"files"},
    "silhouettes": VALUES,
    "carving": VALUES,
    "matching": VALUES,
    "dense": VALUES | {"matching"},
    # from geometry to motion paths
    "trajectories": VALUES,
    "patches": VALUES | {"carving", "matching", "trajectories"},
    "nodes": VALUES,
    "keypoints": VALUES | {"files"},
    # from motion paths or points to bodies, joints, and the subject's model
    "segmentation": VALUES,
    "bodies": VALUES | {"trajectories"},
    "skeleton": VALUES | {"bodies", "segmentation"},
    "subject": VALUES | {"bodies", "skeleton", "trajectories"},
    # out of the house
    "export": VALUES | {"files", "skeleton", "subject"},
    "evaluation": VALUES | {"files", "export"},
    "inspection": VALUES | {"files", "export", "evaluation"},
}
ROOMS["config"] = set(ROOMS)
ROOMS["pipeline"] = set(ROOMS)
ROOMS["geomocap"] = set(ROOMS)
ROOMS["data_tools"] = VALUES | {"files", "silhouettes"}
ROOMS["viz"] = VALUES | {"files", "calibration", "keypoints", "trajectories", "export", "evaluation", "inspection"}
ROOMS["cli"] = set(ROOMS)
ROOMS["__main__"] = {"cli"}

KNOWN_ARROWS = {
    ("model", "export"),
    ("model", "files"),
    ("files", "geomocap"),
    ("export", "geomocap"),
    ("pipeline", "geomocap"),
    ("viz", "config"),
    ("viz", "dense"),
    ("viz", "matching"),
    ("viz", "pipeline"),
}
KNOWN_CLASSES = {"CameraView", "Ellipsoids", "Skeleton"}
KNOWN_LONG = {"viz.review"}

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
    assert _twice(name for source in SOURCES for name in source.classes) >= KNOWN_CLASSES


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
    assert _twice(name for source in SOURCES for name in source.classes) <= KNOWN_CLASSES


def test_modules_have_names_that_say_something_and_stay_short():
    # Numba's cache watches a kernel's own file only: kernels that call each other have to stay in one
    for source in SOURCES:
        assert source.file.stem not in {"utils", "util", "helpers", "common", "misc"}, source.name
        limit = 500 if "kernel" in source.file.stem else 400
        lines = len(source.file.read_text().splitlines())
        assert lines <= limit or source.name in KNOWN_LONG, f"{source.name} has {lines} lines, more than {limit}"


def test_every_package_is_looked_at():
    assert {source.name.split(".")[0] for source in SOURCES} == set(PACKAGES)


def _twice(names) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}
