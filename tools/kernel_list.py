"""Write the list of kernels that the demo calls, `geomocap/kernels_ahead.json`.

    python -m tools.kernel_list

The demo runs with one thread and an empty cache of kernels, in a temporary folder: several minutes. To be repeated when
kernels have come, gone or got arguments of other types; what is not right in the list costs time and nothing else.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

Call = tuple[str, str, tuple[Any, ...]]
"""Module and name of a kernel, and Numba's types of its arguments."""


def main() -> None:
    """Run the demo and write which kernels Python called, in the order of the first calls."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["NUMBA_CACHE_DIR"] = folder  # before Numba is imported
        calls = demo_calls(Path(folder) / "demo")
    from geomocap.kernels_ahead import LIST

    LIST.write_text(list_of(calls), encoding="utf-8")


def demo_calls(folder: Path) -> list[Call]:
    """Run the demo into a folder and return what was compiled for Python; kernels that only these call are not told."""
    from numba.core import event

    import geomocap.cli  # chooses the folder of the kernels

    calls: list[Call] = []
    depth = threading.local()

    class Listener(event.Listener):
        """Notes the outermost of compilations inside each other."""

        def on_start(self, event: Any) -> None:
            """Note it."""
            depth.value = getattr(depth, "value", 0) + 1
            if depth.value == 1:
                kernel = event.data["dispatcher"].py_func
                calls.append((kernel.__module__, kernel.__qualname__, tuple(event.data["args"])))

        def on_end(self, event: Any) -> None:
            """Count it."""
            depth.value -= 1

    sys.argv = ["geomocap", "demo", str(folder), "--workers", "1"]
    with event.install_listener("numba:compile", Listener()):
        try:
            geomocap.cli.main()
        except SystemExit as end:
            if end.code:
                raise
    return calls


def list_of(calls: Iterable[Call]) -> str:
    """Return the list's text, a kernel a line; kernels with arguments that it has no words for are left out."""
    from geomocap.kernels_ahead import code_of

    lines = []
    for module, name, kinds in calls:
        try:
            lines.append(json.dumps([module, name, [code_of(kind) for kind in kinds]]))
        except TypeError:
            continue
    return "[\n" + ",\n".join(lines) + "\n]\n"


if __name__ == "__main__":
    main()
