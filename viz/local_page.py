"""Pages served on this machine by viser, which answer their own window only (see `viz.own_pages`)."""

from __future__ import annotations

import contextlib
import io
import logging
import threading
from typing import Any

from geomocap.export.export_errors import require
from viz.own_pages import own_pages_only

_making = threading.Lock()  # only one server is made at a time, see `own_pages_only`


def serve_page(label: str, host: str, port: int, *, extra: str, purpose: str) -> Any:
    """Start a viser server that refuses requests from foreign pages.

    Parameters
    ----------
    label : str
        Title of the page.
    host : str
        Address to listen on.
    port : int
        The next free one is taken if it is in use.
    extra, purpose : str
        Extra of geomocap that installs viser, and what it is for, should it be missing.

    Raises
    ------
    MissingPackageError
        If viser isn't installed.
    """
    viser = require("viser", extra=extra, purpose=purpose)
    # browsers open connections ahead that they never use, which isn't worth a traceback
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with _making, own_pages_only(host), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, label=label, verbose=False)
