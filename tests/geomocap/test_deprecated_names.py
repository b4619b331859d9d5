"""Names of version 0.1.0 that scripts may use go on, with a warning that says what takes their place."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from geomocap.errors import GeomocapError
from geomocap.files.rigs import write_rig
from geomocap.model.rig import Rig
from tests.small_files import rig


@pytest.mark.parametrize(
    ("module", "name", "instead"),
    [("geomocap.cameras", "Rig", "open_capture"), ("geomocap.geometry", "Voxels", "read_voxels")],
)
def test_old_names_read_and_say_what_takes_their_place(module: str, name: str, instead: str, tmp_path: Path):
    sys.modules.pop(module, None)
    with pytest.warns(DeprecationWarning, match=instead):
        old = getattr(importlib.import_module(module), name)
    with pytest.raises(GeomocapError, match="missing"):
        old.read(tmp_path / "missing")


def test_an_old_rig_is_a_rig(tmp_path: Path):
    write_rig(tmp_path / "sparse", rig())
    sys.modules.pop("geomocap.cameras", None)
    with pytest.warns(DeprecationWarning):
        old = importlib.import_module("geomocap.cameras").Rig
    read = old.read(tmp_path / "sparse")
    assert isinstance(read, Rig) and issubclass(old, Rig)
    assert read.names == rig().names
