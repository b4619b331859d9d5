"""NPZ files of plain arrays: nothing in them is ever executed, and they are written whole or not at all."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from geomocap.errors import RunError
from geomocap.files.atomic import write_atomic


def write_npz(path: Path, arrays: dict[str, Any]) -> None:
    """Write plain arrays, whole or not at all.

    Raises
    ------
    RunError
        If an array holds objects, or the file can't be written.
    """
    for key, value in arrays.items():
        if np.asarray(value).dtype == object:
            raise RunError(f"{path.name}: {key} is no plain array")

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_atomic(path, write)


def read_npz(path: Path, only: Collection[str] = (), needed: Collection[str] = ()) -> dict[str, np.ndarray]:
    """Read the arrays of a file, or those named in `only`.

    Raises
    ------
    RunError
        If the file is missing or damaged, or has no array of one of the names `needed`.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files if not only or key in only}
    except FileNotFoundError:
        raise RunError(f"{path}: missing; run the stage that writes it") from None
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RunError(f"{path}: damaged ({reason}); delete it and run again") from None
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise RunError(f"{path}: has no array {', '.join(missing)}; delete it and run again")
    return arrays
