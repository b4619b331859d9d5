"""The pages: what they name is there, what is generated is up to date, and they build without a network."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import textwrap
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from pydantic import BaseModel

import geomocap
from geomocap.cli.app import COMMANDS
from geomocap.cli.capture_commands import convert, import_
from geomocap.config import Config
from geomocap.keypoints.keypoint_regions import read_keypoints
from tests.benchmarks.quality import row
from tests.geomocap.moving_chains import chain
from tools.result_tables import ROOT, measured_now, read_table, read_tables
from tools.results_page import results_page, with_table

PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
GENERATED = {ROOT / "docs" / "changelog.md"}  # made when the pages are built
TABLES = read_tables(ROOT / "docs" / "results")


def links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL))


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", h.lower()).strip()) for h in headings}


def in_ticks(page: Path) -> set[str]:
    return set(re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for link in links(page):
        if link.startswith(("http://", "https://")):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if target in GENERATED:
            continue
        assert target.exists(), f"{page}: {link}"
        assert not anchor or anchor in anchors(target), f"{page}: {link}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_modules_and_functions_that_pages_name_are_there(page):
    for name in in_ticks(page):
        if not re.fullmatch(r"geomocap(\.\w+)+", name):
            continue
        module, found = name, None
        while found is None and "." in module:
            found = _spec(module)
            module = module.rpartition(".")[0] if found is None else module
        rest = name[len(module) :].strip(".")
        assert found is not None or hasattr(geomocap, rest), f"{page}: {name}"
        if found is not None and rest:
            assert re.search(rf"^(class|def) {rest}\b|^{rest}\b", Path(found).read_text(), re.MULTILINE), (
                f"{page}: {name}"
            )


def _spec(module: str) -> str | None:
    try:
        spec = find_spec(module)
    except ModuleNotFoundError:
        return None
    return spec.origin if spec else None


@pytest.mark.parametrize("page", [p for p in PAGES if p.name != "CHANGELOG.md"], ids=lambda p: str(p.relative_to(ROOT)))
def test_settings_that_pages_name_are_there(page):
    tables = set(Config.model_fields)
    for name in in_ticks(page):
        key = re.fullmatch(r"(?:--)?(\w+)((?:\.\w+)+)(?: .*)?", name)
        if key is None or key[1] not in tables or name.endswith((".npz", ".toml", ".json")):
            continue
        table: type[BaseModel] = Config
        for part in f"{key[1]}{key[2]}".split("."):
            assert part in table.model_fields, f"{page}: {name}"
            kind = table.model_fields[part].annotation
            table = kind if isinstance(kind, type) and issubclass(kind, BaseModel) else BaseModel


def test_commands_that_pages_name_are_there_and_all_are_named():
    named = set()
    for page in PAGES:
        named |= set(re.findall(r"(?:^ {4}(?:\.venv/bin/)?|`)geomocap ([a-z][a-z-]+)", page.read_text(), re.MULTILINE))
    assert named == set(COMMANDS)


def test_kinds_and_formats_of_calibrations_that_the_page_lists_are_those_of_the_commands():
    page = (ROOT / "docs" / "calibration.md").read_text().partition("## Calibrations of other tools")[2]
    table, _, formats = page.partition("`--format` is")
    cells = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    kinds, written = (
        set(get_args(get_args(inspect.signature(f, eval_str=True).parameters["kind"].annotation)[0]))
        for f in (import_, convert)
    )
    assert set(re.findall(r"`(\w+)`", " ".join(cells))) == kinds
    assert set(re.findall(r"`(\w+)`", formats.partition("\n\n")[0])) == written
    assert written <= kinds


def test_key_points_of_the_page_can_be_read(tmp_path):
    page = (ROOT / "docs" / "keypoints.md").read_text()
    example = page[page.index("    links") : page.index("    geomocap keypoints RUN")]
    (tmp_path / "keypoints.toml").write_text(textwrap.dedent(example))
    assert read_keypoints(tmp_path / "keypoints.toml").names == ["hand", "elbow"]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 700


def test_the_lines_of_python_in_the_readme_run_without_any_folder(tmp_path, monkeypatch, capsys):
    lines = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    np.save(tmp_path / "tracks.npy", chain(3).positions)
    monkeypatch.chdir(tmp_path)
    assert len(lines) == 1 and len([line for line in lines[0].splitlines() if line]) == 5
    exec(lines[0], {})
    assert capsys.readouterr().out.startswith("3 ['joint_body")


def test_results_are_those_of_the_data():
    assert (ROOT / "docs" / "results.md").read_text() == results_page(TABLES)
    readme = (ROOT / "README.md").read_text()
    assert readme == with_table(readme, TABLES)


def test_rows_of_results_say_where_they_come_from(tmp_path):
    path = tmp_path / "table.toml"
    path.write_text((ROOT / "docs/results/whole-runs.toml").read_text())
    table = read_table(path)
    figures = {
        "bodies.found": 15.0,
        "truth.bodies": 16.0,
        "bodies.adjusted_rand_index": 0.5,
        "bodies.core_adjusted_rand_index": 0.6,
        "joints.recall_at_5%h": 0.7,
        "joints.precision_at_10%h": 0.8,
        "joints.mean_error": 21.4,
        "skeleton.true_edges_found": 0.8,
        "skeleton.false_edges": 1.0,
        "motion.body_rotation_error_deg": 3.21,
    }
    measured = [row(name, figures) | measured_now("the command", 3) for name in ("fan", "a new one")]
    table.with_rows(measured).write()
    again = read_table(path)
    assert len(again.values["rows"]) == len(table.values["rows"]) + 1
    page = results_page([again])
    cells = "15 / 16 | 0.50 | 0.60 | 0.70 / 0.80 | 21 | 12 / 15, 1 | 3.2 |"
    assert f"| fan | {cells}" in page and f"| a new one | {cells}" in page
    assert f"fan; a new one: commit {measured[0]['commit']}" in page and "seed 3, `the command`.\n" in page
    with pytest.raises(ValueError, match="row fan says no seed"):
        again.with_rows([{"name": "fan", "commit": "1234567"}])


def test_the_changelog_knows_the_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    versions = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert version in versions[:2]


def test_pages_build_and_fetch_nothing(tmp_path):
    pytest.importorskip("mkdocs", reason="the pages want the extra docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "arithmatex" not in (tmp_path / "method/lsmta.html").read_text()
    fetched = re.compile(r'<(?:script|img|iframe|source)[^>]*\bsrc="(?:https?:)?//|<link[^>]*\bhref="https?://')
    for page in tmp_path.rglob("*.html"):
        assert not fetched.search(page.read_text()), page
    for style in tmp_path.rglob("*.css"):
        assert not re.search(r"(?:@import|url\()\s*[\"']?(?:https?:)?//", style.read_text()), style
