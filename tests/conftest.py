"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


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
