"""What `--help` says."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from geomocap.cli import app as commands
from geomocap.cli.app import app

COMMANDS = {name: commands.load(name) for name in commands.COMMANDS}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_placeholder_is_taken_as_markup(name):
    command = COMMANDS[name]
    for text in (command.help, *(getattr(p, "help", None) for p in command.params)):
        assert not re.search(r"<\w+>", re.sub("`[^`]*`", "", text or "")), text


def test_placeholders_are_shown(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    for name, said in (("calibrate", "CAPTURE/bar/<camera>.mp4"), ("synthesize", "videos/<camera>.mp4")):
        with pytest.raises(SystemExit):
            app([name, "--help"])
        assert said in capsys.readouterr().out


@pytest.mark.parametrize("name", ["review", "keypoints", "export", "evaluate"])
def test_a_run_that_must_be_there_is_not_said_to_be_made(name):
    run = next(p for p in COMMANDS[name].params if p.name == "run")
    assert "Run folder" in run.help and "made" not in run.help


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_takes_a_settings_file_and_a_number_of_workers(name):
    flags = {flag for p in COMMANDS[name].params for flag in p.opts}
    assert {"--config", "--workers"} <= flags


@pytest.mark.parametrize("name", ["run", "segment"])
def test_the_number_of_bodies_has_a_short_flag(name):
    assert ["--bodies"] in [p.opts for p in COMMANDS[name].params]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_commands_says_what_their_own_help_says(name):
    first = COMMANDS[name].help.split("\n\n")[0]
    assert " ".join(first.split()) == commands.COMMANDS[name][1]


def test_help_of_the_main_job_shows_about_forty_flags():
    shown = [p for p in COMMANDS["run"].params if p.param_type_name == "option"]
    assert 30 <= len(shown) <= 46


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["run", "--help"]])
def test_help_loads_nothing_that_computes(arguments):
    code = (
        "import sys, geomocap.cli\n"
        f"sys.argv = ['geomocap', *{arguments}]\n"
        "try:\n    geomocap.cli.main()\n"
        "except SystemExit:\n    pass\n"
        "print(*[m for m in ('numpy', 'numba', 'scipy', 'open3d', 'cv2', 'matplotlib') if m in sys.modules], 'end')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "end"


def test_commands_without_pictures_load_no_plots():
    code = (
        "import sys, geomocap.cli.jobs, geomocap.cli.stage_commands, geomocap.pipeline; "
        "print(*[m for m in ('matplotlib', 'viz') if m in sys.modules], 'end')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["end"]
