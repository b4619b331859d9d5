"""Kernels of the later stages, compiled by a second process while the first stages are at work.

A run on a new machine compiles more than a hundred kernels, one after the other. `kernels_ahead.json` lists those that
the standard way from a capture to its report calls, with the types of their arguments, in the order of the first calls;
`python -m tools.kernel_list` writes it. The second process begins at the end of the list, puts what it compiles into
the cache that all processes read (see `geomocap.kernel_cache`) and skips what it finds there: so the two meet in the
middle. Whether it runs, fails or is ended changes no result.
"""

from __future__ import annotations

import gc
import hashlib
import importlib
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

LIST = Path(__file__).with_suffix(".json")


@contextmanager
def kernels_compiled_ahead(workers: int | None = None) -> Iterator[None]:
    """Compile the listed kernels in a second process beside the block, unless they have been compiled before.

    The process ends with the block at the latest, and with this process should that be killed.

    Parameters
    ----------
    workers : int, optional
        Threads that the block may use; with one, nothing is done beside it.
    """
    beside = _begin() if (workers or os.cpu_count() or 1) > 1 else None
    try:
        yield
    finally:
        if beside is not None:
            beside.kill()
            beside.communicate()


def _begin() -> subprocess.Popen[bytes] | None:
    done = _note()
    if done is None or done.exists():
        return None
    with suppress(OSError):
        return subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,  # closed when this process ends, however it does
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl+C is for this process, which ends the other one
        )
    return None


def _note() -> Path | None:
    """Empty file that says that all is compiled for this machine; None where nothing can be kept.

    Each copy of the package has its own, as Numba keeps the kernels of each place apart.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if not folder or os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
        return None
    from importlib.metadata import version

    from llvmlite import binding

    machine = f"{platform.python_version()}-numba{version('numba')}-{binding.get_host_cpu_name()}"
    place = hashlib.sha256(os.fsencode(LIST.parent)).hexdigest()[:12]
    return Path(folder) / f"ahead-{machine}-{place}"


def listed() -> list[tuple[str, str, list[Any]]]:
    """Return module, name and the arguments' codes of the listed kernels, in the order of their first calls."""
    return [(module, name, codes) for module, name, codes in json.loads(LIST.read_text(encoding="utf-8"))]


def compile_listed(entries: Sequence[tuple[str, str, list[Any]]]) -> None:
    """Compile kernels, the last ones first, or find them in the cache; those that can't be compiled are left out."""
    for module, name, codes in reversed(entries):
        with suppress(Exception):
            getattr(importlib.import_module(module), name).compile(tuple(type_of(code) for code in codes))


def code_of(kind: Any) -> Any:
    """Return what stands for one of Numba's types in the list.

    "int64", "none", "float64:2C" for an array, a list for a tuple.

    Raises
    ------
    TypeError
        If it is another one.
    """
    from numba import types

    if isinstance(kind, types.UniTuple | types.Tuple):
        return [code_of(part) for part in kind.types]
    if isinstance(kind, types.Array) and kind.aligned:
        return f"{code_of(kind.dtype)}:{kind.ndim}{kind.layout}{'' if kind.mutable else 'r'}"
    if isinstance(kind, types.Number | types.Boolean | types.NoneType):
        return str(kind)
    raise TypeError(f"{kind}: is no number, array or tuple")


def type_of(code: Any) -> Any:
    """Return Numba's type that a code of the list stands for."""
    from numba import types

    if isinstance(code, list):
        return types.BaseTuple.from_types([type_of(part) for part in code])
    name, _, shape = code.partition(":")
    scalar = types.boolean if name == "bool" else getattr(types, name)
    return types.Array(scalar, int(shape[0]), shape[1], readonly=shape.endswith("r")) if shape else scalar


def _end_with_parent() -> None:
    os.read(0, 1)  # nothing is written: it ends when the other end is closed
    os._exit(0)


def main() -> None:
    """Compile the whole list, as the process beside another one."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    gc.set_threshold(100_000)  # compiling makes many objects that stay
    compile_listed(listed())
    done = _note()
    if done is not None:
        done.touch()


if __name__ == "__main__":
    main()
