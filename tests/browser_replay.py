"""Check `simreplay --web` in a real browser: `make test-browser`. Not collected by `make test`: it needs Chromium.

The DevTools protocol opens the page in headless Chromium. The checks are that the viewer has loaded the flight and
drawn something, and that all requests went to this machine.
"""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from replaykit import OLD_LOG, free_port
from websockets.sync.client import ClientConnection, connect

PATIENCE_S = 90.0  # WebAssembly of 40 MB, compiled and drawn in software


def browser() -> str:
    """Return the path of the browser, or skip the test if none is installed."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if (found := shutil.which(name)) is not None:
            return found
    pytest.skip("there is no Chromium on this machine (Debian, Ubuntu: apt install chromium)")


@pytest.fixture
def served() -> Iterator[tuple[str, int]]:
    """Yield the address and the port of the page."""
    port = free_port()
    command = [sys.executable, "-m", "maxq.tools.simreplay", str(OLD_LOG), "--web", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        yield line.removeprefix("open ").strip(), port
        process.terminate()


class Page:
    """A tab of the browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._number = socket, 0
        self.answers: list[str] = []
        self.errors: list[str] = []

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE_S))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return dict(message.get("result", {}))
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("method") == "Network.responseReceived":
            self.answers.append(message["params"]["response"]["url"])
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(message["params"]["exceptionDetails"])[:500])

    def picture(self) -> np.ndarray:
        data = base64.b64decode(self.do("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("L"), float)


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    port = free_port()
    command = [
        browser(),
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--ignore-gpu-blocklist",
        "--window-size=1280,800",
        "--no-first-run",
        f"--user-data-dir={tmp_path}",
        f"--remote-debugging-port={port}",
        "about:blank",
    ]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            with connect(_tab(port), max_size=None) as socket:
                yield Page(socket)
        finally:
            process.terminate()


def _tab(port: int) -> str:
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                return str(next(t for t in json.load(answer) if t["type"] == "page")["webSocketDebuggerUrl"])
        except (OSError, StopIteration):
            time.sleep(0.1)
    pytest.fail("Chromium does not answer")


def test_the_page_shows_the_flight(served: tuple[str, int], page: Page) -> None:
    url, port = served
    assert re.fullmatch(rf"http://127\.0\.0\.1:{port}/\?url=rerun%2Bhttp%3A%2F%2F127\.0\.0\.1%3A\d+%2Fproxy", url)
    for domain in ("Page", "Network", "Runtime"):
        page.do(f"{domain}.enable")
    page.do("Page.navigate", url=url)
    deadline, picture = time.monotonic() + PATIENCE_S, np.zeros((800, 1280))
    while time.monotonic() < deadline:
        time.sleep(1.0)
        earlier, picture = picture, page.picture()
        if _is_replay(picture) and np.abs(picture - earlier).max() < 2.0:
            break
    Image.fromarray(picture.astype(np.uint8)).save("browser-replay.png")
    assert _is_replay(picture), "see browser-replay.png"
    assert page.errors == []
    away = [u for u in page.answers if not re.match(r"(https?://(127\.0\.0\.1|localhost)[:/]|data:|blob:|about:)", u)]
    assert away == []


def _is_replay(picture: np.ndarray) -> bool:
    """Return True if the close-up (left), the plots (middle) and the text (right) all have content."""
    height, width = picture.shape
    rows = slice(height // 8, -height // 8)
    parts = [picture[rows, a * width // 20 : b * width // 20] for a, b in ((4, 7), (9, 12), (12, 15), (17, 20))]
    return all(part.std() > 8.0 for part in parts)


def test_the_server_listens_on_this_machine_only(served: tuple[str, int]) -> None:
    _, port = served
    listening = Path("/proc/net/tcp")
    if not listening.exists():
        pytest.skip("listening sockets are read from /proc/net/tcp, which only Linux has")
    rows = [line.split() for line in listening.read_text().splitlines()[1:]]
    locals_ = [row[1] for row in rows if row[3] == "0A" and row[1].endswith(f":{port:04X}")]
    assert locals_ == [f"0100007F:{port:04X}"]
