"""Pages that this machine serves, for its own user only: other pages in the same browser can't speak to them.

A browser lets any page open a web socket to any address, 127.0.0.1 too, and says only afterwards from where. So the
origin of a request must be the page's own address, and the host that it asks for one of this machine's names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

LOCAL = ("localhost", "127.0.0.1", "::1")


def is_own(headers: dict[str, str], address: str) -> bool:
    """Whether a request may be answered.

    Parameters
    ----------
    headers : dict
        "Host" and "Origin" of the request, as far as it has them.
    address : str
        What the server listens on; behind one that isn't only this machine's, any IP address or its own name is right.
    """
    asked = headers.get("Host", "")
    name = urlsplit(f"//{asked}").hostname or ""
    if address in LOCAL:
        if name not in LOCAL:
            return False
    elif name not in (*LOCAL, address) and not _is_address(name):
        return False
    origin = headers.get("Origin")
    return origin is None or (origin.partition("://")[0] in ("http", "https") and origin.partition("://")[2] == asked)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


@contextmanager
def own_pages_only(address: str) -> Iterator[None]:
    """Let servers of web sockets that are started in the block answer their own pages only."""
    import websockets.asyncio.server as sockets

    begin = sockets.serve

    def serve(*arguments: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            headers = {name: request.headers[name] for name in ("Host", "Origin") if name in request.headers}
            if not is_own(headers, address):
                return connection.respond(HTTPStatus.FORBIDDEN, "this page answers its own address only\n")
            return process_request(connection, request) if process_request is not None else None

        return begin(*arguments, process_request=answer, **options)

    sockets.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        sockets.serve = begin  # type: ignore[misc]
