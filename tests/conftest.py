"""What all tests share: the folder of data, and the command line as users call it."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from tools.slow_tests import listed


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that are on the list of slow ones."""
    slow = listed()
    for item in items:
        if item.nodeid.partition("[")[0] in slow:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of characters and real recordings that `GEOMOCAP_DATA` names; tests that need it skip without."""
    folder = os.environ.get("GEOMOCAP_DATA")
    if not folder:
        pytest.skip("GEOMOCAP_DATA is not set: characters and real recordings are not here")
    path = Path(folder)
    if not path.is_dir():
        pytest.fail(f"GEOMOCAP_DATA names {path}, which is no folder")
    return path


@dataclass(frozen=True)
class Finished:
    """How a call of the command line ended."""

    returncode: int
    stderr: str


Command = Callable[..., Finished]


@pytest.fixture(scope="session")
def geomocap() -> Command:
    """Call the command line's own entry point, in this process, with its errors caught as the shell would see them."""

    from geomocap.cli import main

    def call(*arguments: object, check: bool = True) -> Finished:
        told = io.StringIO()
        status: int | str | None = 0
        with pytest.MonkeyPatch.context() as patch, redirect_stderr(told), redirect_stdout(io.StringIO()):
            patch.setattr(sys, "argv", ["geomocap", *map(str, arguments)])
            try:
                main()
            except SystemExit as end:
                status = end.code
        code = status if isinstance(status, int) else 0 if status is None else 1
        if check:
            assert code == 0, told.getvalue()
        return Finished(code, told.getvalue())

    return call
