"""Files and names from outside: opened only if they are plain files, read with limits, shown without doing anything.

Every reader of the three packages goes through here: a pipe in place of a file isn't waited for, a text isn't taken in
without end, and what a parser says of a broken one is one line.
"""

from __future__ import annotations

import json
import os
import stat
import struct
import tomllib
from pathlib import Path
from typing import Any, BinaryIO

from geomocap.errors import GeomocapError, harmless, shortened

__all__ = [
    "check_name",
    "harmless",
    "list_folder",
    "open_plain",
    "parse_toml",
    "read_bytes",
    "read_json",
    "read_text",
    "read_toml",
    "reason",
    "shortened",
]

MOST_TEXT = 1 << 24  # bytes of a settings file or record; a thousand times what any of them needs
LONGEST_NAME = 100  # characters; with an ending still a file name on every disk


def open_plain(path: Path) -> BinaryIO:
    """Open a file for reading if it is a plain one: no folder, and no pipe or device, which might never end.

    Raises
    ------
    OSError
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(21, "it is a folder", str(path))
        if not stat.S_ISREG(mode):
            raise OSError(22, "it is a pipe or a device, no file", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """Read a plain file of at most `most` bytes; raises OSError."""
    with open_plain(path) as file:
        length = os.fstat(file.fileno()).st_size
        if most is not None and length > most:
            raise OSError(27, f"{length:,} bytes, expected {most:,} at the most", str(path))
        return file.read()


def list_folder(folder: Path, error: type[GeomocapError]) -> list[Path]:
    """List what is in a folder, sorted; raises `error` if it can't be read."""
    try:
        return sorted(folder.iterdir())
    except OSError as failed:
        raise error(f"{folder}: can't be read ({failed.strerror or failed}); make it readable") from None


def read_text(path: Path, error: type[GeomocapError], hint: str = "", most: int = MOST_TEXT) -> str:
    """Read a UTF-8 text, with or without byte order mark.

    Parameters
    ----------
    path : Path
    error : type of GeomocapError
        What to raise.
    hint : str
        What to do if it can't be read.
    most : int
        Bytes that it may have.
    """
    after = f"; {hint}" if hint else ""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except OSError as failed:
        raise error(f"{path}: can't be read ({failed.strerror or failed}){after}") from None
    except UnicodeDecodeError as failed:
        raise error(f"{path}: no text in UTF-8 (byte {failed.start}){after}") from None


def read_toml(path: Path, error: type[GeomocapError], hint: str = "") -> dict[str, Any]:
    """Read a TOML file; raises `error` if it can't be read or is none."""
    return parse_toml(read_text(path, error, hint), path, error, hint)


def parse_toml(text: str, path: Path | str, error: type[GeomocapError], hint: str = "") -> dict[str, Any]:
    """Read TOML from a text; raises `error` if it is none."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as failed:
        after = f"; {hint}" if hint else ""
        raise error(f"{path}: not valid TOML ({reason(failed)}){after}") from None


def check_entries(record: dict[str, Any], path: Path, error: type[GeomocapError], hint: str = "") -> None:
    """Refuse a run's record with fewer values than it says (`geomocap.entries`): cut at a line's end, it is still TOML.

    Records that don't say it, of older versions, pass, and so does what isn't a run's record.
    """
    own = record.get("geomocap")
    said = own.get("entries") if isinstance(own, dict) else None
    if type(said) is int and (there := count_values(record)) < said:
        after = f"; {hint}" if hint else ""
        raise error(f"{path}: cut off, it has {there} of the {said} values that geomocap.entries says{after}")


def count_values(table: dict[str, Any]) -> int:
    """Count the values in a table and those below it; an array is one."""
    return sum(count_values(value) if isinstance(value, dict) else 1 for value in table.values())


def read_json(path: Path, error: type[GeomocapError], hint: str = "delete it and run again") -> Any:
    """Read a JSON file; raises `error` if it can't be read or is none."""
    text = read_text(path, error, hint)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as failed:
        raise error(f"{path}: damaged ({reason(failed)}); {hint}") from None


def reason(failed: BaseException) -> str:
    """Say in a few words of one line what a library found wrong, without its addresses and source files."""
    if isinstance(failed, RecursionError):
        return "nested too deeply"
    if isinstance(failed, MemoryError | OverflowError):
        return "it claims impossible sizes"
    if isinstance(failed, struct.error | EOFError):
        return "it ends too early"
    if isinstance(failed, OSError) and failed.strerror:
        return failed.strerror
    if isinstance(failed, ValueError) and "integer string conversion" in str(failed):
        return "a number with thousands of digits"
    lines = [line.strip() for line in str(failed).splitlines() if line.strip()]
    return harmless(shortened(lines[0] if lines else type(failed).__name__, 120))


def check_name(name: str, where: str, error: type[GeomocapError], what: str = "camera") -> None:
    """Refuse a name from outside that can't stand in a file name: what leads elsewhere, isn't seen or has no end.

    Parameters
    ----------
    name : str
    where : str
        File that it comes from.
    error : type of GeomocapError
        What to raise.
    what : str
        Whose name it is.
    """
    why = ""
    if not name.strip():
        why = "is empty"
    elif len(name) > LONGEST_NAME or len(os.fsencode(name.encode("utf-8", "replace"))) > 2 * LONGEST_NAME:
        why = f"has {len(name)} letters, at most {LONGEST_NAME} can be used"
    elif any(c in "/\\" for c in name) or name in (".", ".."):
        why = "leads to another folder"
    elif harmless(name) != name or "\n" in name or "\t" in name:
        why = "holds characters that can't be shown"
    if why:
        raise error(f"{where}: name of {what} '{harmless(shortened(name))}' {why}; give it a plain name")
