"""Kernels of later stages are compiled by a second process, which nothing depends on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numba
import numpy as np
import pytest

from geomocap import kernels_ahead
from geomocap.kernel_cache import configure_numba
from geomocap.kernels_ahead import code_of, compile_listed, kernels_compiled_ahead, listed, type_of


@numba.njit
def _sum_of(values, pair, flag):
    return values.sum() + pair[0][0] if flag else pair[1]


VALUES = np.arange(3.0)
KINDS = [numba.typeof(v) for v in (VALUES, (VALUES.reshape(1, 3)[0], 2), True, np.int32(1), VALUES[::2])]


@pytest.mark.parametrize("kind", KINDS)
def test_types_are_read_as_they_were_written(kind):
    assert type_of(json.loads(json.dumps(code_of(kind)))) == kind


def test_read_only_arrays_are_told_apart():
    fixed = VALUES.copy()
    fixed.flags.writeable = False
    assert code_of(numba.typeof(fixed)) == "float64:1Cr" != code_of(numba.typeof(VALUES))
    assert type_of("float64:1Cr") == numba.typeof(fixed)


def test_other_types_have_no_code():
    with pytest.raises(TypeError, match="no number"):
        code_of(numba.typeof("text"))


def test_listed_kernels_are_there_with_as_many_arguments():
    entries = listed()
    assert len(entries) > 20
    for module, name, codes in entries:
        kernel = getattr(import_module(module), name)
        assert kernel.py_func.__code__.co_argcount == len(codes), f"{module}.{name}: python -m tools.kernel_list"
        assert all(type_of(code) is not None for code in codes)


def test_kernels_are_compiled_for_their_listed_types_and_others_left_out():
    good = [code_of(k) for k in KINDS[:3]]
    wrong = [(__name__, "_sum_of", ["int64"]), (__name__, "nothing", good), ("no.such.module", "kernel", good)]
    compile_listed([*wrong, (_sum_of.__module__, "_sum_of", good), *wrong])
    assert _sum_of.signatures == [tuple(KINDS[:3])]


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernels_ahead.os, "cpu_count", lambda: 2)
    return tmp_path


def _alive(number):
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{number}/stat")  # one that has ended may still wait to be asked how
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


def _started(monkeypatch):
    begun = []

    class Seen(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            begun.append(self)

    monkeypatch.setattr(kernels_ahead.subprocess, "Popen", Seen)
    return begun


def test_the_second_process_ends_with_the_block(empty_cache, monkeypatch):
    begun = _started(monkeypatch)
    with pytest.raises(KeyboardInterrupt), kernels_compiled_ahead():
        assert begun[0].poll() is None
        raise KeyboardInterrupt
    assert begun[0].returncode is not None and not _alive(begun[0].pid)


def test_nothing_is_started_where_all_is_compiled_or_one_thread_is_wanted(empty_cache, monkeypatch):
    begun = _started(monkeypatch)
    with kernels_compiled_ahead(workers=1):
        pass
    kernels_ahead._note().touch()
    with kernels_compiled_ahead():
        pass
    assert begun == []
    kernels_ahead._note().unlink()
    with kernels_compiled_ahead():
        pass
    assert len(begun) == 1


def test_a_process_that_cannot_be_started_is_done_without(empty_cache, monkeypatch):
    monkeypatch.setattr(kernels_ahead.sys, "executable", str(empty_cache / "none"))
    with kernels_compiled_ahead():
        pass


def test_the_second_process_ends_when_the_first_is_killed(empty_cache):
    first = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import time, geomocap.kernels_ahead as k\n"
            "second = k._begin()\n"
            "print(second.pid, flush=True)\n"
            "time.sleep(600)",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    second = int(first.stdout.readline())
    assert _alive(second)
    first.kill()
    first.communicate()
    for _ in range(600):
        if not _alive(second):
            break
        time.sleep(0.1)
    assert not _alive(second)


def test_the_second_process_ends_well_by_itself(empty_cache):
    words = "import geomocap.kernels_ahead as k; k.listed = lambda: []; k.main()"
    second = subprocess.Popen([sys.executable, "-c", words], stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert second.wait(60) == 0
    assert second.communicate()[1] == b""


def test_what_was_compiled_is_noted(empty_cache, monkeypatch):
    configure_numba()
    monkeypatch.setattr(kernels_ahead, "listed", lambda: [])
    monkeypatch.setattr(kernels_ahead, "_end_with_parent", lambda: None)
    kernels_ahead.main()
    assert kernels_ahead._note().exists()


def test_another_copy_of_the_package_is_noted_apart(empty_cache, monkeypatch, tmp_path):
    here = kernels_ahead._note()
    monkeypatch.setattr(kernels_ahead, "LIST", tmp_path / kernels_ahead.LIST.name)
    assert here is not None and kernels_ahead._note() not in (None, here)
