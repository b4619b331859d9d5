"""Settings: one TOML file, flags over it, unknown keys named."""

from __future__ import annotations

import pytest

from geomocap.config import Config, load_config
from geomocap.errors import SettingsError


def test_file_and_overrides_are_merged(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text("[carving]\nresolution = 128\n[carving.hull]\noutside = 'unseen'\nmin_views = 3\n")
    config = load_config(file, {"carving": {"hull": {"min_views": 4}}})
    assert (config.carving.resolution, config.carving.hull.outside, config.carving.hull.min_views) == (128, "unseen", 4)
    assert config.segmentation == Config().segmentation


def test_run_toml_is_a_settings_file(tmp_path):
    file = tmp_path / "run.toml"
    file.write_text("[geomocap]\nversion = '1'\n[source]\npath = 'x'\n[config.carving]\nresolution = 99\n")
    assert load_config(file).carving.resolution == 99


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[carving]\nresolutoin = 3", r"a\.toml: unknown setting carving\.resolutoin; known there are resol"),
        ("[cloud.merge]\nspan = 3", r"unknown setting cloud\.merge\.span; known there are distance, support$"),
        ("[carving]\nresolution = 'big'", r"setting carving\.resolution = 'big': must be a valid integer"),
        ("[carving]\nresolution = true", r"carving\.resolution = True: must be a number, not true or false"),
        ("[scans]\nscale = true", r"scans\.scale = True: must be a number"),
        ("[scans]\nspacing = false", r"scans\.spacing = False: must be a number"),
        ("[carving]\nvolume = [[0, 0, 0], [1, true, 1]]", r"carving\.volume = .*: must be a number"),
        ("[nodes]\ncolors = 'blue'", r"nodes\.colors = 'blue'"),
        ("[carving.hull]\noutside = 'here'", r"carving\.hull\.outside = 'here'"),
        ("[carving]\nmargin = inf", r"carving\.margin = inf"),
        ("carving = ", "not valid TOML"),
    ],
)
def test_wrong_settings_are_named(tmp_path, text, said):
    file = tmp_path / "a.toml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=said):
        load_config(file)


def test_missing_settings_file(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.toml: can't be read"):
        load_config(tmp_path / "none.toml")


def test_every_setting_has_a_description():
    def check(model, path):
        for key, field in model.model_fields.items():
            if isinstance(field.annotation, type) and hasattr(field.annotation, "model_fields"):
                check(field.annotation, f"{path}{key}.")
            else:
                assert field.description, f"{path}{key} has no description"

    check(Config, "")
