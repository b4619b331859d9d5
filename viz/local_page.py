"""Pages served on this machine by viser: who may talk to them.

A page that listens on 127.0.0.1 can still be reached by whatever website the user has open, because web sockets know no
same-origin rule. So every request must come from the page itself: its `Origin`, where a browser sends one, must be the
`Host` that it was sent to, and that host must be this machine where nothing else is listened on (a foreign name that
resolves to 127.0.0.1 is refused).
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import logging
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from geomocap.export.export_errors import require

_making = threading.Lock()  # only one server is made at a time, see `_guarded`


def is_own(origin: str | None, host: str | None, address: str) -> bool:
    """Whether a request comes from a page that this server has sent, or from a program that is no browser.

    Parameters
    ----------
    origin, host : str or None
        Headers of the request.
    address : str
        What the server listens on.
    """
    if host is None:
        return False
    if _is_local(address) and not _is_local(urlsplit(f"//{host}").hostname or ""):
        return False
    return origin is None or urlsplit(origin).netloc.lower() == host.lower()


def _is_local(host: str) -> bool:
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


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
    with _making, _guarded(host), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, label=label, verbose=False)


@contextlib.contextmanager
def _guarded(address: str) -> Iterator[None]:
    """Let servers made meanwhile check every request first; viser itself has no such option."""
    import websockets.asyncio.server as library

    serve = library.serve

    def guarded(*arguments: Any, process_request: Callable[[Any, Any], Any] | None = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            headers = request.headers
            origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
            one = len(origins) <= 1 and len(hosts) == 1
            if not one or not is_own(origins[0] if origins else None, hosts[0], address):
                return connection.respond(HTTPStatus.FORBIDDEN, "This page talks to its own window only.\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*arguments, process_request=checked, **options)

    library.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        library.serve = serve  # type: ignore[misc]
