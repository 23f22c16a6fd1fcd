"""Headless Chromium controlled over its DevTools protocol: pages, keys and screenshots."""

import base64
import json
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",  # Tests may run as root.
    "--no-first-run",
    "--disable-dev-shm-usage",
    "--use-gl=angle",  # WebGL on the CPU.
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--window-size=960,600",
)
START_TIMEOUT_S = 60
MAX_ANSWER_BYTES = 64_000_000  # Size of the largest screenshot.


class Page:
    """Page of a browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._last_id = socket, 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and return its result."""
        self._last_id += 1
        message = {"id": self._last_id, "method": method, "params": parameters}
        self._socket.send(json.dumps(message))
        while True:  # Events arrive in between.
            response = json.loads(self._socket.recv(timeout=START_TIMEOUT_S))
            if response.get("id") == self._last_id:
                return response["result"]

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get(
            "value"
        )

    def text(self) -> str:
        """Return the text of the page."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def click_checkbox(self, label: str) -> None:
        """Click the checkbox of the panel with this label."""
        clicked = self.evaluate(
            f"""(() => {{
                const labels = [...document.querySelectorAll('label')];
                const box = document.getElementById(
                    labels.find(one => one.innerText.trim() === {label!r})?.htmlFor);
                box?.click();
                return Boolean(box);
            }})()"""
        )
        assert clicked, f"no checkbox {label!r} in {self.text()}"

    def type_into(self, selector: str, text: str) -> None:
        """Replace the text of an input field and press Enter."""
        self.evaluate(f"document.querySelector({selector!r}).select()")
        self.call("Input.insertText", text=text)
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key="Enter",
                code="Enter",
                text="\r",
                windowsVirtualKeyCode=13,
            )

    def screenshot(self) -> np.ndarray:
        """Return a screenshot, RGB uint8 [H, W, 3]."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return image[..., ::-1]

    def wait_for(self, condition: Callable[[], bool], what: str, timeout_s: float = 60) -> None:
        until_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < until_s, f"no {what} within {timeout_s} s: {self.text()}"
            time.sleep(0.2)


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """Open a page in a new browser; skip the test if none is installed."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("needs a headless Chromium: `apt-get install chromium`")
    log_path = folder / "chromium.log"
    with log_path.open("w") as log:
        command = [path, *FLAGS, f"--user-data-dir={folder / 'profile'}", "about:blank"]
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            with connect(_address(process, log_path), max_size=MAX_ANSWER_BYTES) as socket:
                yield Page(socket)
        finally:
            process.kill()
            process.wait()


def _address(process: subprocess.Popen[bytes], log: Path) -> str:
    """Return the address of the first page's socket."""
    until_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < until_s and process.poll() is None:
        if found := re.search(r"ws://(127\.0\.0\.1:\d+)/", log.read_text()):
            with urllib.request.urlopen(f"http://{found[1]}/json/list") as response:
                pages = [target for target in json.load(response) if target["type"] == "page"]
            if pages:
                return pages[0]["webSocketDebuggerUrl"]
        time.sleep(0.1)
    pytest.fail(f"Chromium did not start: {log.read_text()}")
