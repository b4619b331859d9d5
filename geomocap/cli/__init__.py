"""The command line: the one place that ties geomocap, data_tools and viz together."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; a mistake of the user's ends with one clear line and exit status 1."""
    from geomocap.cli.app import app
    from geomocap.errors import GeomocapError

    try:
        app()
    except GeomocapError as error:
        print(f"geomocap: {' '.join(str(error).split())}", file=sys.stderr)  # noqa: T201
        sys.exit(1)
    except KeyboardInterrupt:
        print("geomocap: interrupted; start it again to go on from what is finished", file=sys.stderr)  # noqa: T201
        sys.exit(130)
