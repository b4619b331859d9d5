"""Where work runs: threads of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Annotated

import typer

from geomocap.errors import SettingsError
from geomocap.scheduling import limit_threads, threads


def _limited(workers: int | None) -> int | None:
    limit_threads(workers)
    return workers


Workers = Annotated[
    int | None,
    typer.Option("--workers", min=1, callback=_limited, help="Threads to use; one for each core if not given."),
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler to map frames on, tcp://host:8786.")
]


@contextmanager
def executor_for(workers: int | None, scheduler: str | None) -> Iterator[Executor]:
    """Make the executor that the options ask for."""
    if scheduler is None:
        with threads(workers) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError:
        raise SettingsError("--scheduler needs Dask: pip install 'geomocap[dask]'") from None
    try:
        client = Client(scheduler, timeout="10s")
    except (OSError, ValueError) as error:
        raise SettingsError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from None
    with client, client.get_executor() as executor:
        yield executor
