"""Mapping over frames: order, bounded memory, errors."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import cv2
import numba
import numpy as np
import pytest

from geomocap.scheduling import limit_threads, map_items, map_rows, spread, threads


def test_results_come_in_order_and_progress_is_told():
    said = []
    with threads(2) as executor:
        results = list(map_items(lambda x: x * x, range(50), executor, "squares", lambda *a: said.append(a)))
    assert results == [x * x for x in range(50)]
    assert said[0] == ("squares", 0, 50) and said[-1] == ("squares", 50, 50)


def test_only_a_few_items_are_under_way():
    started = []
    with threads(2) as executor:
        stream = map_items(lambda x: started.append(x) or x, range(1000), executor, ahead=4)
        next(stream)
        assert len(started) <= 6
        stream.close()
    assert len(started) <= 6


def test_first_error_is_raised_and_the_rest_not_begun():
    def work(x):
        if x == 3:
            raise ValueError("frame 3")
        return x

    with threads(1) as executor, pytest.raises(ValueError, match="frame 3"):
        list(map_items(work, range(100), executor, ahead=2))


def test_threads_share_the_cores():
    with threads(2) as executor:
        names = set(executor.map(lambda _: threading.current_thread().name, range(8)))
    assert 1 <= len(names) <= 2


@pytest.mark.parametrize(("workers", "count", "few"), [(1, 100, 1), (3, 100, 1), (3, 2, 1), (3, 5, 8), (4, 0, 1)])
def test_parts_of_a_kernels_work_are_all_done_once(monkeypatch, workers, count, few):
    monkeypatch.setattr(numba, "get_num_threads", lambda: workers)
    done, names = [], set()

    def kernel(begin, end, offset):
        names.add(threading.current_thread().name)
        done.extend(offset + k for k in range(begin, end))

    spread(kernel, count, 1000, few=few)
    assert sorted(done) == [1000 + k for k in range(count)]
    if workers == 1 or count <= few:
        assert names <= {threading.current_thread().name}
    else:
        assert 1 <= len(names) <= workers


def test_the_caller_and_its_helpers_work_side_by_side(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 3)
    together, met = threading.Barrier(3, timeout=30), set()

    def kernel(begin, end):
        name = threading.current_thread().name
        if name not in met:
            met.add(name)
            together.wait()

    spread(kernel, 100)
    assert len(met) == 3 and threading.current_thread().name in met


@pytest.mark.parametrize("caller", [True, False])
def test_an_error_of_the_caller_or_of_a_helper_is_raised_when_all_have_ended(monkeypatch, caller):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    together, own, ended = threading.Barrier(2, timeout=30), threading.current_thread(), []

    def kernel(begin, end):
        mine = threading.current_thread() is own
        if begin < 2:  # of 16 parts the first two, by whichever thread
            together.wait()
        if mine == caller:
            raise ValueError("here" if mine else "there")
        ended.append(begin)

    with pytest.raises(ValueError, match="here" if caller else "there"):
        spread(kernel, 16)
    assert len(ended) == 15


@pytest.mark.parametrize("count", [0, 1, 7])
def test_rows_are_worked_on_in_parts_and_put_together(count):
    numbers = np.arange(count)
    double, square = map_rows(lambda rows: (2 * numbers[rows], numbers[rows] ** 2), count)
    assert np.array_equal(double, 2 * numbers) and np.array_equal(square, numbers**2)


def test_an_error_in_a_part_is_raised(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)

    def kernel(begin, end):
        if begin <= 7 < end:
            raise ValueError("item 7")

    with pytest.raises(ValueError, match="item 7"):
        spread(kernel, 20)


def test_a_limit_holds_for_executors_and_kernels_made_afterwards():
    try:
        limit_threads(1)
        with threads() as executor:
            assert executor._max_workers == 1
        assert numba.get_num_threads() == 1 and cv2.getNumThreads() == 1
    finally:
        limit_threads(None)
    with threads() as executor:
        assert executor._max_workers == (os.cpu_count() or 1)
    assert numba.get_num_threads() == numba.config.NUMBA_NUM_THREADS


@pytest.mark.parametrize("first", ["geomocap", "numpy"])
@pytest.mark.parametrize(("chosen", "used"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, min(2, os.cpu_count() or 1))])
def test_matrices_are_multiplied_in_one_thread_unless_the_user_says_otherwise(first, chosen, used):
    inherited = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    words = (
        f"import {first}, geomocap, numpy, threadpoolctl as t; print({{i['num_threads'] for i in t.threadpool_info()}})"
    )
    told = subprocess.check_output([sys.executable, "-c", words], env=inherited | chosen, text=True)
    assert told.strip() == f"{{{used}}}"
