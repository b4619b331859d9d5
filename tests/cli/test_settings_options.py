"""Flags, `--set` and the settings file: one way in, and unknown ones named."""

from __future__ import annotations

import pytest
import typer

from geomocap.cli.settings_options import command_class, with_options_of, with_settings
from geomocap.config import Config
from geomocap.errors import SettingsError
from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.settings import flag_of, leaves


def called(decorate, arguments, name="config"):
    """Settings that a command decorated so gets from arguments."""
    got = []

    def config_command(where: str, config: Config) -> None:
        got.append((where, config))

    def settings_command(where: str, settings: EvaluationSettings) -> None:
        got.append((where, settings))

    command = decorate(config_command if name == "config" else settings_command)
    app = typer.Typer()
    app.command(cls=command_class(command))(command)
    typer.main.get_command(app).main(["place", *arguments], standalone_mode=False)
    assert got[0][0] == "place"
    return got[0][1]


def run(*arguments):
    return called(with_settings("carving", "motion_bodies", "export"), arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--resolution", "64"],
        ["--resolution=64"],
        ["--carving.resolution", "64"],
        ["--carving.resolution=64"],
        ["--set", "carving.resolution=64"],
        ["--set", "carving.resolution = 64"],
        ["--resolution", "32", "--set", "carving.resolution=64"],
        ["--carving.resolution", "32", "--resolution", "64"],
    ],
)
def test_a_setting_has_three_ways_in_and_the_last_one_holds(arguments):
    assert run(*arguments).carving.resolution == 64


def test_keys_without_a_flag_nested_tables_and_lists(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text("[motion_bodies]\nradius = 0.05\nreach = 0.1\n")
    found = run(
        "--config", str(file), "--motion_bodies.radius", "0.06", "--carving.hull.outside", "empty",
        "--set", "carving.volume=[[0, 0, 0], [1, 1, 1]]", "--min-turn", "20", "--export.skin-colors", "true",
    )  # fmt: skip
    assert (found.motion_bodies.radius, found.motion_bodies.reach, found.motion_bodies.min_turn_deg) == (0.06, 0.1, 20)
    assert found.export.skin_colors == "true"
    assert found.carving.hull.outside == "empty" and found.carving.volume == ((0, 0, 0), (1, 1, 1))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--contact_weight", "1"], r"takes no settings of the table \[motion_skeleton\]"),
        (["--refinement", "1"], r"takes no settings of the table \[refinement\]"),
        (["--first-cut-deg", "2"], r"key first_cut_deg of the table \[motion_bodies\].*--set motion_bodies\.first"),
        (["--tolerance", "2"], r"is the key tolerance of the table \[carving\.hull\]"),
        (["--nodes.colors", "false"], r"takes no settings of the table \[nodes\]"),
        (["--set", "carving.resolutoin=3"], r"no setting carving\.resolutoin; did you mean carving\.resolution\?"),
        (["--set", "carving.resolution"], "expected TABLE.KEY=VALUE"),
        (["--resolution"], "--resolution needs a value"),
        (["--resolution", "many"], r"setting carving\.resolution = 'many'"),
        (["--no-such", "1"], "No such option"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(arguments, said):
    with pytest.raises(Exception, match=said) as caught:
        run(*arguments)
    assert isinstance(caught.value, SettingsError) or type(caught.value).__name__ == "NoSuchOption"


def test_a_command_with_its_own_settings_shows_all_of_them():
    found = called(with_options_of(EvaluationSettings), ["--every", "2", "--set", "align=true"], "settings")
    assert (found.every, found.align) == (2, True)


def test_flags_are_different_from_each_other_and_named_like_flags():
    flags = [flag for _, field in leaves(Config) if (flag := flag_of(field)) is not None]
    assert len(set(flags)) == len(flags)
    assert all(flag == flag.lower() and "_" not in flag for flag in flags)
