"""A headless Chromium driven over its DevTools protocol, where one is found."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu-sandbox"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--hide-scrollbars", "--no-first-run", "--disable-background-networking"),
    "--disable-extensions",
)


def chromium() -> str:
    """The browser's program, or the test is skipped."""
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("no Chromium: install one (Debian: apt-get install chromium), or name its "
                    "program by CHROMIUM")  # fmt: skip
    return found


class PageError(AssertionError):
    """The browser could not do what it was asked."""


class Page:
    """One open page: runs scripts, takes pictures, keeps what the console said."""

    def __init__(self, socket: Any):
        self._socket = socket
        self._count = 0
        self.console: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """One command and its answer; events on the way are kept."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == self._count:
                if "error" in message:
                    raise PageError(f"{method}: {message['error']}; {self.console}")
                return message["result"]
            self._keep(message)

    def _keep(self, message: dict[str, Any]) -> None:
        params = message.get("params", {})
        if message["method"] == "Runtime.exceptionThrown":
            self.console.append(f"exception: {json.dumps(params)[:800]}")
        elif message["method"] == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.console.append(f"error: {json.dumps(params['args'])[:800]}")
        elif message["method"] == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.console.append(f"log: {params['entry']['text']} {params['entry'].get('url')}")

    def open(self, url: str, width: int = 800, height: int = 600) -> None:
        """Load a page into a window of this size."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        self.send("Page.navigate", url=url)

    def run(self, script: str) -> Any:
        """Value of an expression in the page."""
        answer = self.send(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, script: str, seconds: float = 60.0) -> Any:
        """Value of an expression as soon as it is true; it must be plain data."""
        end = time.monotonic() + seconds
        while True:
            value = self.run(script)
            if value:
                return value
            assert time.monotonic() < end, f"{script}: not true after {seconds} s; {self.console}"
            time.sleep(0.05)

    def picture(self) -> np.ndarray:
        """What the window shows, uint8 (H, W, 3)."""
        data = self.send("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def wait_until(self, good: Callable[[np.ndarray], bool], seconds: float = 60.0) -> np.ndarray:
        """The first picture that is good."""
        end = time.monotonic() + seconds
        while True:
            # A page that is just being replaced by the next one has no picture.
            with contextlib.suppress(PageError):
                picture = self.picture()
                if good(picture):
                    return picture
            assert time.monotonic() < end, f"no such picture after {seconds} s; {self.console}"


@contextmanager
def open_browser() -> Iterator[Page]:
    """A page of a fresh browser, closed at the end."""
    connect = pytest.importorskip(
        "websockets.sync.client", reason="no websockets: pip install -e '.[view]'"
    ).connect
    program = chromium()
    folder = tempfile.mkdtemp(prefix="chromium-")
    command = [program, *FLAGS, "--remote-debugging-port=0", f"--user-data-dir={folder}"]
    process = subprocess.Popen(
        [*command, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        port = _port(Path(folder) / "DevToolsActivePort", process)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=30) as answer:
            pages = [p for p in json.load(answer) if p["type"] == "page"]
        address = pages[0]["webSocketDebuggerUrl"]
        with connect(address, max_size=None, compression=None, open_timeout=30) as socket:
            yield Page(socket)
    finally:
        process.terminate()
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def _port(file: Path, process: subprocess.Popen[bytes]) -> int:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if process.poll() is not None:
            pytest.skip(f"Chromium ended with status {process.returncode}: it cannot run here")
        if file.is_file() and file.read_text().strip():
            return int(file.read_text().split()[0])
        time.sleep(0.05)
    pytest.skip("Chromium opened no DevTools port within a minute")
