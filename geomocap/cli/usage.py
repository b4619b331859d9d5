"""What is wrong with a command line itself, in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer

from geomocap.errors import GeomocapError

_MISUSE: Any = typer.BadParameter.__mro__[1]  # typer's own error of usage, or click's, by version


class UsageError(GeomocapError):
    """A command, flag, argument or value that can't be."""


@contextmanager
def usage_in_one_line(context: Any = None) -> Iterator[None]:
    """Raise UsageError for what typer finds wrong with a command line.

    Parameters
    ----------
    context : Context, optional
        Of the group of commands, which knows the command that is called.

    Raises
    ------
    UsageError
    """
    try:
        yield
    except _MISUSE as error:
        words = error.format_message().replace("Value error, ", "").replace("Input should be", "must be").rstrip(". ")
        called = getattr(context, "invoked_subcommand", None)
        command = f"geomocap {called}" if called else "geomocap"
        raise UsageError(f"{words[:1].lower()}{words[1:]}; try `{command} --help`") from None
