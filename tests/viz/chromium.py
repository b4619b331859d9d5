"""A headless Chromium that draws in software, driven by its own protocol over a web socket."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

FLAGS = (
    "--headless=new",
    "--remote-debugging-port=0",
    "--remote-allow-origins=*",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--no-first-run",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--hide-scrollbars",
)


class Page:
    """A page of the browser: what it says on its console, what it fetched, its pixels, and its mouse."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._count = socket, 0
        self.complaints: list[str] = []
        self.fetched: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; what happens meanwhile is remembered."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self._remember(answer)

    def _remember(self, event: dict[str, Any]) -> None:
        what = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                details = what["exceptionDetails"]
                self.complaints.append(details.get("exception", {}).get("description") or details["text"])
            case "Runtime.consoleAPICalled" if what["type"] in ("error", "assert", "warning"):
                self.complaints.append(" ".join(str(a.get("value", a.get("description"))) for a in what["args"]))
            case "Log.entryAdded" if what["entry"]["level"] == "error":
                self.complaints.append(what["entry"]["text"])
            case "Network.requestWillBeSent":
                self.fetched.append(what["request"]["url"])

    def show(self, width: int, height: int, dark: bool = False, density: float = 1, touch: bool = False) -> None:
        """Set the window's size and the reader's wishes."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": density, "mobile": touch}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        wish = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[wish])

    def open(self, address: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=address)
        self.wait(f"location.href === {json.dumps(address)} && document.readyState === 'complete'")

    def run(self, script: str) -> Any:
        """Evaluate JavaScript and return its value."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, condition: str, seconds: float = 60) -> None:
        """Wait until JavaScript says yes."""
        end = time.monotonic() + seconds
        while not self.run(condition):
            assert time.monotonic() < end, f"never came true: {condition}; {self.complaints}"
            time.sleep(0.05)

    def pixels(self, selector: str | None = None) -> np.ndarray:
        """Return what is shown of an element, or of the window: (H, W, 3) uint8."""
        clip = {}
        if selector:
            x, y, w, h = self.box(selector)
            top = self.run("scrollY")
            clip = {"clip": {"x": x, "y": y + top, "width": w, "height": h, "scale": 1}}
        data = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=bool(selector), **clip)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Return x, y, width and height of an element in the window."""
        found = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        script = f"(r => [r.x, r.y, r.width, r.height])({found})"
        x, y, w, h = self.run(script)
        return x, y, w, h

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Move or press the mouse: mouseMoved, mousePressed, mouseReleased."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        """Click somewhere in the window."""
        self.mouse("mouseMoved", x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)


@contextmanager
def chromium(*flags: str) -> Iterator[Page]:
    """Open a page of a headless Chromium; the test is skipped where there is none."""
    client = pytest.importorskip("websockets.sync.client", reason="driving a browser needs the package websockets")
    names = ("chromium", "chromium-browser", "google-chrome")
    program = next((found for name in names if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip("no chromium is installed (apt-get install chromium)")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        command = [program, *FLAGS, *flags, f"--user-data-dir={home}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = _port(Path(home) / "DevToolsActivePort", process)
            with client.connect(f"ws://127.0.0.1:{port[0]}{port[1]}", max_size=None) as browser:
                browser.send(json.dumps({"id": 1, "method": "Target.getTargets"}))
                targets = json.loads(browser.recv(timeout=60))["result"]["targetInfos"]
            target = next(t["targetId"] for t in targets if t["type"] == "page")
            address = f"ws://127.0.0.1:{port[0]}/devtools/page/{target}"
            with client.connect(address, max_size=None, open_timeout=60) as socket:
                yield Page(socket)
        finally:
            process.terminate()
            process.wait(30)


def _port(file: Path, process: subprocess.Popen[bytes]) -> tuple[str, str]:
    """Port and path that the browser listens on, once it has written them."""
    for _ in range(600):
        if file.is_file() and len(lines := file.read_text().split()) == 2:
            return lines[0], lines[1]
        if process.poll() is not None:
            pytest.skip(f"chromium can't be started here (status {process.returncode})")
        time.sleep(0.05)
    raise AssertionError("chromium doesn't answer")
