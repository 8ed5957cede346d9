"""A headless Chromium, driven by the DevTools protocol over a WebSocket."""

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
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from bodyseg_data.core import MissingLibrary

_NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
_OPTIONS: Final = (
    "--headless=new",
    "--no-sandbox",  # as root in a container there is none
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # as without a network
    "--remote-debugging-port=0",
)
_START_S: Final = 60.0
_POLL_S: Final = 0.1


class Tab:
    """A page in the browser. requested: addresses that it asked for, WebSockets among them. errors: of its console."""

    def __init__(self, connection: Connection, session: str) -> None:
        self._connection, self._session = connection, session
        self._number = 0
        self.requested: list[str] = []
        self.errors: list[str] = []
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.command(f"{domain}.enable")

    def command(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Run a DevTools command and return its result. Raises RuntimeError with what the browser says of it."""
        self._number += 1
        number = self._number
        message = {"id": number, "method": method, "params": parameters, "sessionId": self._session}
        self._connection.send(json.dumps(message))
        while True:
            reply: dict[str, Any] = json.loads(self._connection.recv(timeout=_START_S))
            if reply.get("id") == number:
                if "error" in reply:
                    raise RuntimeError(f"{method}: {reply['error']}")
                result: dict[str, Any] = reply["result"]
                return result
            self._note(reply)

    def open(self, address: str) -> None:
        """Go to an address."""
        self.command("Page.navigate", url=address)

    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression. Raises RuntimeError if it throws."""
        result = self.command("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{script}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def wait_for(self, script: str, timeout_s: float) -> None:
        """Wait until a JavaScript expression is true. Raises TimeoutError."""
        end = time.monotonic() + timeout_s
        while not self.evaluate(script):
            if time.monotonic() > end:
                raise TimeoutError(f"{script} was not true within {timeout_s:g} s")
            time.sleep(_POLL_S)

    def screenshot(self) -> NDArray[np.uint8]:
        """Picture of the window, sRGB uint8 [H, W, 3]."""
        data = base64.b64decode(self.command("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 6) -> None:
        """Press the mouse at a point of the window, move to another and let go; x and y in pixels."""
        (x, y), (to_x, to_y) = start, end
        self._mouse("mouseMoved", x, y)
        self._mouse("mousePressed", x, y)
        for step in range(1, steps + 1):
            self._mouse("mouseMoved", x + (to_x - x) * step / steps, y + (to_y - y) * step / steps)
        self._mouse("mouseReleased", to_x, to_y)

    def _mouse(self, kind: str, x: float, y: float) -> None:
        self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def _note(self, event: dict[str, Any]) -> None:
        method, given = event.get("method"), event.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requested.append(given["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requested.append(given["url"])
        elif method == "Runtime.exceptionThrown":
            self.errors.append(str(given["exceptionDetails"].get("exception", {}).get("description", given)))


def chromium() -> str | None:
    """Path of a Chromium on this machine, or None."""
    return next((found for name in _NAMES if (found := shutil.which(name))), None)


@contextmanager
def open_tab(width: int, height: int) -> Iterator[Tab]:
    """Start a browser with a window of this size, pixels, and give an empty page of it; it ends with the block.

    Raises MissingLibrary if there is no Chromium, RuntimeError if it does not start.
    """
    program = chromium()
    if program is None:
        raise MissingLibrary("a browser is needed: apt-get install chromium")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        options = [*_OPTIONS, f"--user-data-dir={folder}", f"--window-size={width},{height}", "about:blank"]
        browser = subprocess.Popen([program, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            with connect(_devtools(Path(folder), browser), max_size=None) as connection:
                yield _tab(connection, width, height)
        finally:
            browser.terminate()
            browser.wait()


def _devtools(folder: Path, browser: subprocess.Popen[bytes]) -> str:
    """Address of the browser's DevTools, which it writes into its folder once it listens."""
    file, end = folder / "DevToolsActivePort", time.monotonic() + _START_S
    while not file.exists() or len(file.read_text().split()) < 2:
        if browser.poll() is not None or time.monotonic() > end:
            raise RuntimeError(f"{browser.args!r} did not start: status {browser.poll()}")
        time.sleep(_POLL_S)
    port, path = file.read_text().split()
    return f"ws://127.0.0.1:{port}{path}"


def _tab(connection: Connection, width: int, height: int) -> Tab:
    """Open a page and talk to it alone."""

    def result_of(number: int, method: str, **parameters: Any) -> dict[str, Any]:
        connection.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (reply := json.loads(connection.recv(timeout=_START_S))).get("id") != number:
            pass
        result: dict[str, Any] = reply["result"]
        return result

    target = result_of(-1, "Target.createTarget", url="about:blank")["targetId"]
    session = result_of(-2, "Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
    tab = Tab(connection, session)
    tab.command("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
    return tab
