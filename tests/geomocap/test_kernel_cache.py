"""Compiled kernels are kept in a folder named by what all kernels do."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from geomocap import kernel_cache
from geomocap.kernel_cache import cache_folder, kernels_digest

CALLED = '''"""Words."""
from numba import njit

@njit(cache=True)
def inner(x):
    """Double it."""
    return 2 * x  # twice
'''
CALLER = """
from numba import njit
from geomocap.called import inner
from geomocap.numbers import STEP

@njit(cache=True)
def outer(x):
    return inner(x) + STEP

def plain(x):
    return outer(x)
"""
NUMBERS = """
from geomocap.far import BASE
HALF = BASE / 2
STEP = 2 * HALF
UNUSED = 5

def far():
    return 3
"""
FAR = "BASE = 1\nOTHER = 2\n"


@pytest.fixture
def sources(tmp_path):
    (tmp_path / "geomocap").mkdir()
    files = {"called": CALLED, "caller": CALLER, "numbers": NUMBERS, "far": FAR, "other": "x = 1\n"}
    for name, text in files.items():
        (tmp_path / f"geomocap/{name}.py").write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("module", "before", "after", "changed"),
    [
        ("called", "2 * x", "3 * x", True),
        ("called", "cache=True", "cache=True, fastmath=True", True),
        ("numbers", "2 * HALF", "4 * HALF", True),
        ("numbers", "BASE / 2", "BASE / 4", True),
        ("far", "BASE = 1", "BASE = 2", True),
        ("far", "OTHER = 2", "OTHER = 3", False),
        ("numbers", "UNUSED = 5", "UNUSED = 6", False),
        ("called", "twice", "two times", False),
        ("called", "Double it.", "Times two.", False),
        ("called", '"""Words."""', '"""Words."""\n\n', False),
        ("caller", "return outer(x)", "return outer(x) + 1", False),
        ("numbers", "return 3", "return 4", False),
        ("other", "x = 1", "x = 2", False),
    ],
)
def test_the_digest_changes_with_the_kernels_alone(sources, module, before, after, changed):
    first = kernels_digest(sources)
    file = sources / f"geomocap/{module}.py"
    assert before in file.read_text()
    file.write_text(file.read_text().replace(before, after))
    assert (kernels_digest(sources) != first) == changed


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_in_another_file_changes(sources):
    (sources / "geomocap/__init__.py").write_text(
        "from geomocap.kernel_cache import configure_numba\nconfigure_numba()\n"
    )
    with open(kernel_cache.__file__) as file:
        (sources / "geomocap/kernel_cache.py").write_text(file.read())
    environment = os.environ | {"NUMBA_CACHE_DIR": str(sources / "cache"), "PYTHONPATH": str(sources)}
    environment.pop("GEOMOCAP_KERNEL_CACHE", None)
    code = (
        "from geomocap.caller import outer\n"
        "print(int(outer(5)), sum(outer.stats.cache_hits.values()), sum(outer.stats.cache_misses.values()))"
    )

    def value_hits_misses():
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, cwd=sources, check=True, capture_output=True, text=True
        )
        return [int(word) for word in done.stdout.split()]

    assert value_hits_misses() == [11, 0, 1]
    assert value_hits_misses() == [11, 1, 0]
    (sources / "geomocap/called.py").write_text(CALLED.replace("2 * x", "3 * x"))
    assert value_hits_misses() == [16, 0, 1]
    assert len([p for p in (sources / "cache/geomocap").iterdir() if p.is_dir()]) == 2


def test_a_folder_that_the_user_has_set_gets_a_sub_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = cache_folder()
    assert folder is not None and folder.parent == tmp_path / "geomocap"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))  # as programs get it that are started from here
    monkeypatch.setenv("GEOMOCAP_KERNEL_CACHE", str(folder))
    assert cache_folder() == folder


def test_where_nothing_can_be_written_another_place_is_taken(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    monkeypatch.setattr(kernel_cache, "_user_cache", lambda: tmp_path / "home")
    folder = cache_folder()
    assert folder is not None and folder.parent == tmp_path / "home/geomocap/kernels"
    monkeypatch.setattr(kernel_cache, "_places", lambda: iter([tmp_path / "file"]))
    assert cache_folder() is None


def test_old_folders_go_and_recent_ones_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "_places", lambda: iter([tmp_path]))
    old = time.time() - 1e6
    for k in range(8):
        (tmp_path / f"old{k}").mkdir()
        os.utime(tmp_path / f"old{k}", (old + k, old + k))
    for k in range(6):
        (tmp_path / f"new{k}").mkdir()
    folder = cache_folder()
    left = {p.name for p in tmp_path.iterdir() if p.is_dir()}
    assert left == {folder.name, *(f"new{k}" for k in range(6))}
    monkeypatch.setattr(kernel_cache, "_digest", lambda base: "next")
    for name in left:
        os.utime(tmp_path / name, (old, old))
    cache_folder()
    assert len([p for p in tmp_path.iterdir() if p.is_dir()]) == 4 and (tmp_path / "next").is_dir()


def test_the_sources_are_parsed_once_for_each_state(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "_places", lambda: iter([tmp_path]))
    folder = cache_folder()
    monkeypatch.setattr(kernel_cache, "kernels_digest", lambda root: pytest.fail("parsed again"))
    assert cache_folder() == folder


def test_all_kernels_stand_at_the_top_of_their_modules():
    """The digest looks for them there."""
    for name in kernel_cache._sources(kernel_cache.ROOT):
        if not name.endswith("kernel_cache.py"):
            text = (kernel_cache.ROOT / name).read_text()
            assert "  @njit" not in text and "  @numba.njit" not in text, name
