"""The command line: the one place that ties geomocap, data_tools and viz together."""

from __future__ import annotations

import gc
import os
import sys

GARBAGE = 100_000  # objects made before those not needed are looked for: compiling and importing make many that stay


def main() -> None:
    """Run the command line; a mistake ends with one clear line and exit status 1, 2 if the command line is wrong."""
    from geomocap.cli.app import app
    from geomocap.cli.error_stream import own_lines_only
    from geomocap.cli.interruption import interruptible
    from geomocap.cli.usage import UsageError
    from geomocap.errors import GeomocapError
    from geomocap.reading import reason

    gc.set_threshold(GARBAGE)
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # what it stumbles over, the one line says
    try:
        with interruptible(), own_lines_only():
            app()
    except UsageError as error:
        _fail(str(error), 2)
    except GeomocapError as error:
        _fail(str(error))
    except OSError as error:
        if error.filename is None:
            raise
        _fail(f"{os.fsdecode(error.filename)}: {reason(error)}")
    except MemoryError:
        _fail("there is not memory enough; use smaller images, a coarser resolution or fewer --workers")
    except KeyboardInterrupt:
        print("geomocap: interrupted; start it again to go on from what is finished", file=sys.stderr)  # noqa: T201
        sys.exit(130)


def _fail(text: str, status: int = 1) -> None:
    """Say in one line what is wrong, whatever characters its names have, and end with an exit status."""
    from geomocap.reading import harmless

    line = harmless(" ".join(text.split()))
    encoding = sys.stderr.encoding or "utf-8"
    print("geomocap: " + line.encode(encoding, "backslashreplace").decode(encoding), file=sys.stderr)  # noqa: T201
    sys.exit(status)
