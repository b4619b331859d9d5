"""Arguments and options that commands share."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer


def _limited(workers: int | None) -> int | None:
    from geomocap.scheduling import limit_threads

    limit_threads(workers)
    return workers


CaptureFolder = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder, with capture.toml.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; made if it isn't there.")]
ExistingRun = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of `geomocap run`, `track` or `segment`.")]
ModelFile = Annotated[
    Path | None,
    typer.Option(
        "--model", metavar="FILE.npz", help="Model of the subject, model.npz of another run: it is followed instead."
    ),
]
Wait = Annotated[bool, typer.Option("--wait", help="If another process works in RUN, wait until it has ended.")]
Pictures = Annotated[bool, typer.Option(help="Make review pictures and the report.")]
MetresPerUnit = Annotated[
    float, typer.Option("--metres-per-unit", min=1e-9, help="Metres in a unit of the calibration, or of scans.")
]
Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        max=max(256, 4 * (os.cpu_count() or 1)),
        callback=_limited,
        help="Threads to use; one for each core if not given.",
    ),
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler to map frames on, tcp://host:8786.")
]
Host = Annotated[
    str, typer.Option("--host", help="Address that the page listens on; others than this one let others in.")
]
Port = Annotated[
    int, typer.Option("--port", min=1, max=65535, help="Port of the page; the next free one if it is taken.")
]


@dataclass(frozen=True)
class Where:
    """Where a command's work runs; `with_settings` makes options of it."""

    workers: Workers = None
    scheduler: Scheduler = None
    wait: Wait = False
