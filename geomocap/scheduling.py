"""Mapping stages over frames with any `concurrent.futures.Executor`, in order, with bounded memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import TypeVar

import cv2
import numba
import numpy as np

from geomocap.progress import Progress, silent

Item = TypeVar("Item")
Result = TypeVar("Result")
Arrays = tuple[np.ndarray, ...]


_PARTS = 8  # of a kernel's work for each thread, which takes the next one when it is ready
MOST_WORKERS = max(256, 4 * (os.cpu_count() or 1))  # threads; each takes memory, and none beyond the cores helps
_limit: int | None = None


def limit_threads(count: int | None) -> None:
    """Limit the threads of this process, of all executors and parallel kernels made from now on.

    Parameters
    ----------
    count : int or None
        None: as many as there are cores.
    """
    global _limit
    _limit = count
    most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    numba.set_num_threads(min(count or most, most))
    cv2.setNumThreads(-1 if count is None else count)


@contextmanager
def threads(workers: int | None = None) -> Iterator[ThreadPoolExecutor]:
    """Make an executor of threads that share the cores: parallel kernels called in them get one core each.

    Parameters
    ----------
    workers : int, optional
        Number of threads; if not given the limit that was set, else the number of cores.
    """
    count = min(workers or _limit or os.cpu_count() or 1, MOST_WORKERS)
    kernel_threads = max(1, numba.get_num_threads() // count)
    with ThreadPoolExecutor(count, initializer=numba.set_num_threads, initargs=(kernel_threads,)) as executor:
        yield executor


def spread(kernel: Callable[..., object], count: int, *arguments: object, few: int = 1) -> None:
    """Call `kernel(begin, end, *arguments)` for all parts of `range(count)`, on the cores that this thread may use.

    Compiling a kernel that has threads of its own takes more than twice as long.

    Parameters
    ----------
    kernel : callable
        Works on the items from `begin` to `end` and doesn't hold the interpreter. No part depends on another.
    count : int
    *arguments
    few : int
        So many items are not worth waking other threads for.
    """
    workers = min(numba.get_num_threads(), count)
    if workers <= 1 or count <= few:
        kernel(0, count, *arguments)
        return
    borders = [count * k // (_PARTS * workers) for k in range(_PARTS * workers + 1)]
    parts = iter([(a, b) for a, b in pairwise(borders) if b > a])  # threads take the next one from it, one by one

    def work() -> None:
        for begin, end in parts:
            kernel(begin, end, *arguments)

    helpers = [_pool(os.getpid(), workers - 1).submit(work) for _ in range(workers - 1)]
    try:
        work()
    finally:  # what is waiting for a thread has nothing to do any more
        left = [helper for helper in helpers if not helper.cancel()]
        wait(left)
    for helper in left:
        helper.result()


@cache
def _pool(process: int, helpers: int) -> ThreadPoolExecutor:
    """Threads that stay for all kernels of a process: they never wait for each other. A forked one has none of them."""
    return ThreadPoolExecutor(helpers, f"kernels-{process}")


def map_here(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return `function(item)` of all items, in their order, on the cores that this thread may use."""
    workers = min(numba.get_num_threads(), len(items))
    if workers <= 1:
        return [function(item) for item in items]
    with threads(workers) as executor:
        return list(executor.map(function, items))


def map_rows(function: Callable[[slice], Arrays], count: int) -> Arrays:
    """Return the arrays of `function(rows)` of all rows of `range(count)`, on the cores that this thread may use.

    No row may depend on another: parts of them are worked on side by side, and what they give is put together.
    """
    workers = max(1, min(numba.get_num_threads(), count))
    borders = [count * k // workers for k in range(workers + 1)]
    parts = map_here(function, [slice(a, b) for a, b in pairwise(borders)])
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def map_items(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    executor: Executor | None,
    stage: str = "",
    progress: Progress = silent,
    ahead: int = 16,
) -> Iterator[Result]:
    """Yield `function(item)` in the order of the items, at most `ahead` of them under way at once.

    The first error cancels what has not begun and is raised. Without an executor the items are done one by one.
    """
    pending: deque[Future[Result]] = deque()
    todo = iter(items)
    done = 0
    progress(stage, 0, len(items))
    if executor is None:
        for item in todo:
            result = function(item)
            done += 1
            progress(stage, done, len(items))
            yield result
        return
    try:
        for item in todo:
            pending.append(executor.submit(function, item))
            if len(pending) >= ahead:
                break
        while pending:
            result = pending.popleft().result()
            for item in todo:
                pending.append(executor.submit(function, item))
                break
            done += 1
            progress(stage, done, len(items))
            yield result
    finally:
        for future in pending:
            future.cancel()
