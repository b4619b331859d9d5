"""What messages and helps name is there: settings, flags, commands, pages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from geomocap.cli.app import COMMANDS, load
from geomocap.config import Config
from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.settings import leaves

ROOT = Path(__file__).parent.parent
FILES = ("npz", "npy", "toml", "json", "txt", "bin", "png", "csv", "glb", "py", "md")
OTHERS = {"--background", "--factory-startup", "--python-exit-code", "--python-expr"}  # of Blender
KEYS = {key for key, _ in leaves(Config)}
TABLES = {key.rpartition(".")[0] for key in KEYS} | {key.partition(".")[0] for key in KEYS}


def texts(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """All strings that are no docstrings, and parts of those that are put together, with their lines."""
    own = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docs = {id(n.body[0].value) for n in ast.walk(tree) if isinstance(n, own) and isinstance(n.body[0], ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield node.lineno, node.value


@pytest.fixture(scope="module")
def said() -> list[tuple[str, str]]:
    """Where something is said, and what: strings of several words."""
    files = [f for package in ("geomocap", "viz", "data_tools") for f in sorted((ROOT / package).rglob("*.py"))]
    return [
        (f"{file.relative_to(ROOT)}:{line}", text)
        for file in files
        for line, text in texts(ast.parse(file.read_text(encoding="utf-8")))
        if " " in text.strip() or text.startswith("--")
    ]


def test_settings_that_messages_name_are_there(said):
    heads = {part for table in TABLES for part in table.split(".")}
    named = [
        (where, key)
        for where, text in said
        for key in re.findall(r"(?<![\w./-])[a-z]\w*(?:\.[a-z]\w*)+(?![\w/(])", text)
        if key.partition(".")[0] in heads and key.rpartition(".")[2] not in FILES
    ]
    assert len(named) > 15
    assert [n for n in named if n[1] not in KEYS | TABLES] == []


def test_flags_that_messages_name_are_there(said):
    commands = [load(name) for name in COMMANDS]
    known = {flag for c in commands for p in c.params for flag in (*p.opts, *p.secondary_opts)} | OTHERS
    known |= {"--help", "--version", *(f"--{key}" for key, _ in leaves(EvaluationSettings))}
    named = [
        (where, flag) for where, text in said for flag in re.findall(r"(?<![\w-])--[a-z][a-z_-]*[a-z](?![\w.])", text)
    ]
    assert len(named) > 50
    assert [n for n in named if n[1] not in known] == []


def test_commands_and_pages_that_messages_name_are_there(said):
    commands = [(where, c) for where, text in said for c in re.findall(r"`geomocap ([a-z-]+)", text)]
    pages = [(where, p) for where, text in said for p in re.findall(r"(?<!\w)(?:docs/[\w/-]+\.md|README\S*)", text)]
    assert commands and pages
    assert [c for c in commands if c[1] not in COMMANDS] == []
    assert [p for p in pages if not (ROOT / p[1]).is_file()] == []
