"""A stage's key holds what the stage's code does, and nothing of code that it doesn't use."""

from __future__ import annotations

import ast

import pytest

from geomocap import source_digest
from geomocap.source_digest import code_digest, imported_modules, modules_behind

SOURCE = '''"""Words."""
from pydantic import Field

LIMIT = 2e-4  # m

class A:
    """More words."""

    step: float = Field(1.0, description="how far (m)")

    def times(self, x):
        """Still more."""
        return LIMIT * x if x in {"a", "b", "c"} else -0.0
'''


@pytest.mark.parametrize(
    ("before", "after", "changed"),
    [
        ("2e-4", "3e-4", True),
        ("Field(1.0", "Field(2.0", True),
        ("LIMIT * x", "LIMIT + x", True),
        ('"c"}', '"d"}', True),
        ("-0.0", "0.0", True),
        ("Words.", "Other words.", False),
        ("Still more.", "Less.", False),
        ('        """Still more."""\n', "", False),
        ("# m", "# metres\n\n\n", False),
        ("how far (m)", "reach (m)", False),
    ],
)
def test_what_code_does_changes_the_digest_and_what_it_says_does_not(before, after, changed):
    assert before in SOURCE
    other = SOURCE.replace(before, after)
    assert (code_digest(ast.parse(other)) != code_digest(ast.parse(SOURCE))) == changed


def test_imports_are_found_wherever_they_stand():
    tree = ast.parse(
        "import numpy\nimport geomocap.errors\nfrom geomocap.files import run\nfrom geomocap.model.rig import Rig\n"
        "def f():\n    try:\n        from geomocap.progress import silent\n"
        "    except ImportError:\n        import geomocap.settings\n"
    )
    assert set(imported_modules(tree, "geomocap")) == {
        "geomocap.errors", "geomocap.files.run", "geomocap.model.rig", "geomocap.progress", "geomocap.settings",
    }  # fmt: skip
    assert set(imported_modules(ast.parse("from . import errors\nfrom .files.run import Run"), "geomocap")) == {
        "geomocap.errors", "geomocap.files.run",
    }  # fmt: skip


def test_a_stage_depends_on_its_kernels_and_not_on_later_stages():
    behind = modules_behind("geomocap.pipeline.voxel_stage")
    assert {"geomocap.carving.block_kernels", "geomocap.carving.visibility", "geomocap.model.rig"} <= behind
    assert not [m for m in behind if m.startswith(("geomocap.bodies", "geomocap.skeleton", "geomocap.cli", "viz"))]
    assert "geomocap.carving.block_kernels" in modules_behind("geomocap.pipeline.segmentation_stage")


def test_changed_code_changes_the_keys_of_the_stages_that_use_it(tmp_path, monkeypatch):
    files = {
        "pipeline/one.py": "from geomocap.kernel import double\n",
        "pipeline/two.py": "import geomocap.other\n",
        "kernel.py": 'def double(x):\n    """Twice."""\n    return 2 * x\n',
        "other.py": "from geomocap.config import TABLE\n",
        "config.py": "from geomocap.kernel import double\nTABLE = 1\n",
    }
    for name, text in files.items():
        (tmp_path / "geomocap" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "geomocap" / name).write_text(text)
    monkeypatch.setattr(source_digest, "ROOT", tmp_path)

    def digests():
        forget()
        return [source_digest.module_digest(f"geomocap.pipeline.{name}") for name in ("one", "two")]

    try:
        before = digests()
        kernel = tmp_path / "geomocap/kernel.py"
        kernel.write_text(kernel.read_text().replace("Twice.", "Two times."))
        assert digests() == before
        kernel.write_text(kernel.read_text().replace("2 * x", "3 * x"))
        after = digests()
        assert after[0] != before[0] and after[1] == before[1]  # settings are not followed: their values are in the key
        monkeypatch.setattr(source_digest, "code_digest", None)  # what is noted is not looked into again
        assert digests() == after
        source_digest._note_file().write_text("damaged")
        monkeypatch.undo()
        monkeypatch.setattr(source_digest, "ROOT", tmp_path)
        assert digests() == after
    finally:
        source_digest._note_file().unlink(missing_ok=True)
        forget()


def forget():
    for known in ("_module_code", "module_digest", "_noted", "_note_file"):
        getattr(source_digest, known).cache_clear()


def test_an_unknown_module_is_refused():
    with pytest.raises(ModuleNotFoundError, match=r"geomocap\.nothing"):
        source_digest.module_digest("geomocap.nothing")
