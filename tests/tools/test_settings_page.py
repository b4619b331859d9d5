"""docs/settings.md says what the models say."""

from __future__ import annotations

from geomocap.config import Config
from geomocap.settings import flag_of, leaves
from tools.settings_page import PAGE, page


def test_the_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == page(), "make settings"


def test_every_setting_has_its_row_with_default_and_flag():
    lines = page().splitlines()
    table = ""
    rows = {}
    for line in lines:
        if line.startswith("## ["):
            table = line[4:].partition("]")[0]
        elif line.startswith("# "):
            table = ""
        elif line.startswith("| `") and table:
            cells = [cell.strip() for cell in line.strip("|").split(" | ")]
            rows[f"{table}.{cells[0].strip('`')}"] = cells
    assert set(rows) == {key for key, _ in leaves(Config)}
    for key, field in leaves(Config):
        flag = flag_of(field)
        assert rows[key][-1] == (f"`--{flag}`" if flag else "")
    assert rows["carving.resolution"][1:4] == ["`256`", "count", "≥ 8, ≤ 2048"]
    assert rows["carving.voxel_size"][1:4] == ["", "m", "> 0"]
    assert rows["motion_bodies.min_turn_deg"][2] == "degrees"


def test_units_are_taken_out_of_the_meaning():
    rows = [line for line in page().splitlines() if line.startswith("| `")]
    assert sum(" (m) " in row or "(px) |" in row for row in rows) == 0
    assert any("| m/s | > 0 | Highest speed; from the data if not given |" in row for row in rows)
