"""The rules that keep the layout livable, checked on the sources."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NOT_IN_THE_LIBRARY = {"typer", "rich", "dask", "distributed", "viser", "data_tools", "viz", "pytest"}
NOT_IN_NUMERIC_CODE = {"matplotlib", "jinja2"}


def imports(file: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


def library_files() -> list[Path]:
    return sorted(p for p in (ROOT / "geomocap").rglob("*.py") if "cli" not in p.parts)


@pytest.mark.parametrize("file", library_files(), ids=lambda p: str(p.relative_to(ROOT)))
def test_library_imports_neither_the_command_line_nor_pictures_nor_captures_in(file):
    assert not imports(file) & (NOT_IN_THE_LIBRARY | NOT_IN_NUMERIC_CODE)


def test_data_tools_and_pictures_do_not_import_the_command_line():
    for file in [*(ROOT / "data_tools").rglob("*.py"), *(ROOT / "viz").rglob("*.py")]:
        assert not imports(file) & {"typer", "rich"}, file
        assert "geomocap.cli" not in file.read_text(), file


def test_importing_the_library_loads_no_command_line():
    code = (
        "import sys, geomocap.pipeline, geomocap.segmentation.m3, geomocap.carving.frames\n"
        "print([m for m in ('typer', 'rich', 'distributed', 'viser', 'viz', 'data_tools') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout.strip() == "[]"


def test_segmentation_sees_points_only():
    for file in (ROOT / "geomocap" / "segmentation").rglob("*.py"):
        text = file.read_text()
        for source in (
            "geomocap.model.frame_geometry",
            "geomocap.files.capture",
            "geomocap.model.rig",
            "geomocap.carving",
            "open3d",
        ):
            assert f"import {source}" not in text and f"from {source}" not in text, f"{file} knows of {source}"


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
    # Numba's cache watches a kernel's own file only: kernels that call each other have to stay in one
    for folder in ("geomocap", "data_tools", "viz"):
        for file in (ROOT / folder).rglob("*.py"):
            assert file.stem not in {"utils", "util", "helpers", "common", "misc"}, file
            limit = 500 if "kernel" in file.stem else 400
            assert len(file.read_text().splitlines()) <= limit, f"{file} is longer than {limit} lines"
