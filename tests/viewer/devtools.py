"""A page in a headless Chromium, driven through its debugging port: what it shows, asks for and does when dragged."""

import base64
import io
import itertools
import json
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .headless import FLAGS

MAX_SECONDS = 60


class Page:
    """One tab. `requests`: addresses that it asked for so far."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self.requests: list[str] = []
        for domain in ("Page", "Network", "Runtime"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=MAX_SECONDS))
            if message.get("method") == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def ask(self, expression: str) -> Any:
        """Value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return found["result"].get("value")

    def picture(self) -> np.ndarray:
        """[H, W, 3] uint8 of the whole window."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 8) -> None:
        """With the left button, in pixels of the window."""
        self._mouse("mousePressed", start)
        for i in range(1, steps + 1):
            at = tuple(round(a + (b - a) * i / steps) for a, b in zip(start, end, strict=True))
            self._mouse("mouseMoved", at)
            time.sleep(0.03)
        self._mouse("mouseReleased", end)

    def _mouse(self, kind: str, at: tuple[int, ...]) -> None:
        x, y = at
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)


@contextmanager
def tab(browser: str, folder: Path, width: int, height: int) -> Iterator[Page]:
    """An empty tab of a new browser that knows no other machine. `folder`: for what it keeps."""
    from websockets.sync.client import connect

    flags = [
        *("--remote-debugging-port=0", f"--window-size={width},{height}", f"--user-data-dir={folder}"),
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
        "--disable-features=BackForwardCache",  # a page that was left is gone
    ]
    process = subprocess.Popen(
        [browser, *FLAGS, *flags, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        port = _debugging_port(folder / "DevToolsActivePort", process)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=MAX_SECONDS) as answer:
            (target,) = [each for each in json.load(answer) if each["type"] == "page"]
        # A browser that draws by software on a busy machine answers late.
        address = target["webSocketDebuggerUrl"]
        with connect(address, max_size=None, proxy=None, ping_interval=None) as socket:
            page = Page(socket)
            page.call(
                "Emulation.setDeviceMetricsOverride",
                width=width,
                height=height,
                deviceScaleFactor=1,
                mobile=False,
            )
            yield page
    finally:
        process.terminate()
        process.wait()


def _debugging_port(file: Path, process: "subprocess.Popen[bytes]") -> int:
    end = time.monotonic() + MAX_SECONDS
    while time.monotonic() < end:
        assert process.poll() is None, "the browser ended"
        if file.is_file() and (lines := file.read_text().splitlines()):
            return int(lines[0])
        time.sleep(0.05)
    raise AssertionError(f"the browser did not open a debugging port within {MAX_SECONDS} s")


def until(found: Any, what: str, seconds: float = MAX_SECONDS) -> Any:
    """What a function gives as soon as it is neither None nor False."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = found()
        if value is not None and value is not False:
            return value
        time.sleep(0.05)
    raise AssertionError(f"not within {seconds} s: {what}")
