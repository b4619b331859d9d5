"""Where work runs: threads of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from geomocap.errors import SettingsError
from geomocap.scheduling import threads

_PATIENCE = "10s"  # for a scheduler to answer


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
        client = Client(scheduler, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise SettingsError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from None
    with client, client.get_executor() as executor:
        yield executor
