"""Whatever is done to a file, reading it gives something or one clear line: no traceback, no crash, no hang."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings

from geomocap.errors import GeomocapError
from geomocap.files.camera_file import CameraDoubts
from geomocap.model.diagnostics import Diagnostics
from tests.damaged_files import damaged, damages, survives
from tests.file_readers import READERS
from tests.found_damages import FOUND

EXAMPLES, UNHURRIED = 40, list(HealthCheck)


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_in_one_line_or_read(name, tmp_path):
    reader = READERS[name]
    file = reader.make(tmp_path)
    whole = file.read_bytes()
    assert survives(reader, file, whole) == ""

    @settings(max_examples=EXAMPLES, deadline=None, database=None, derandomize=True, suppress_health_check=UNHURRIED)
    @given(damages())
    def any_damage(done):
        survives(reader, file, damaged(whole, done))

    any_damage()


@pytest.mark.parametrize("name", READERS)
def test_files_cut_off_are_refused_or_read(name, tmp_path):
    reader = READERS[name]
    file = reader.make(tmp_path)
    whole = file.read_bytes()
    for sixteenth in range(16):
        survives(reader, file, whole[: len(whole) * sixteenth // 16])
    file.unlink()
    file.mkdir()
    try:
        assert reader.read(file) in (None, [], {}, set(), Diagnostics(), CameraDoubts())  # what need not be there
    except GeomocapError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(("name", "done"), FOUND)
def test_what_once_broke_a_reader_is_refused_or_read(name, done, tmp_path):
    file = READERS[name].make(tmp_path)
    survives(READERS[name], file, damaged(file.read_bytes(), done))
