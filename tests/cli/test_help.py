"""What `--help` says."""

from __future__ import annotations

import re

import pytest
import typer

from geomocap.cli.app import app

COMMANDS = typer.main.get_command(app).commands


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
    assert ["--motion_bodies.bodies", "--bodies"] in [p.opts for p in COMMANDS[name].params]
