"""Pages of this machine answer nobody else's."""

from __future__ import annotations

import pytest

from viz.own_pages import is_own, own_pages_only


@pytest.mark.parametrize(
    ("host", "origin", "address", "own"),
    [
        ("127.0.0.1:8080", None, "127.0.0.1", True),
        ("127.0.0.1:8080", "http://127.0.0.1:8080", "127.0.0.1", True),
        ("localhost:8080", "http://localhost:8080", "127.0.0.1", True),
        ("[::1]:8080", "http://[::1]:8080", "::1", True),
        ("127.0.0.1:8080", "http://evil.example", "127.0.0.1", False),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", "127.0.0.1", False),
        ("127.0.0.1:8080", "null", "127.0.0.1", False),
        ("127.0.0.1:8080", "file://", "127.0.0.1", False),
        ("evil.example:8080", "http://evil.example:8080", "127.0.0.1", False),  # a name that was turned to this machine
        ("evil.example:8080", "http://evil.example:8080", "0.0.0.0", False),
        ("192.168.1.5:8080", "http://192.168.1.5:8080", "0.0.0.0", True),
        ("studio:8080", "http://studio:8080", "studio", True),
        ("", None, "127.0.0.1", False),
    ],
)
def test_only_the_pages_own_address_may_ask(host, origin, address, own):
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    assert is_own(headers, address) is own


def test_a_server_refuses_foreign_pages(unused_port=18700):
    viser = pytest.importorskip("viser", reason="the key-point editor needs viser (extra editor)")
    connect = pytest.importorskip("websockets.sync.client").connect
    exceptions = pytest.importorskip("websockets.exceptions")
    with own_pages_only("127.0.0.1"):
        server = viser.ViserServer(host="127.0.0.1", port=unused_port, verbose=False)
    try:
        address = f"127.0.0.1:{server.get_port()}"
        spoken = [f"viser-v{viser.__version__}"]
        with connect(f"ws://{address}", origin=f"http://{address}", subprotocols=spoken, proxy=None) as mine:
            assert mine.recv(timeout=5)
        with (
            pytest.raises(exceptions.InvalidStatus, match="403"),
            connect(f"ws://{address}", origin="http://evil.example", subprotocols=spoken, proxy=None),
        ):
            pass
    finally:
        server.stop()
