"""Mapping stages over frames with any `concurrent.futures.Executor`, in order, with bounded memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2
import numba

from geomocap.progress import Progress, silent

Item = TypeVar("Item")
Result = TypeVar("Result")


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
