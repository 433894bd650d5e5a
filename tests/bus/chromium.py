"""A headless Chromium driven over its DevTools pipe: enough to open a page, watch it and use it as people do.

Commands and events are JSON with a NUL behind each, over file descriptors 3 and 4 of the browser (Chrome
DevTools Protocol, `--remote-debugging-pipe`).
"""

import base64
import fcntl
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LIMIT_S = 60.0
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-extensions",
    "--disable-default-apps", "--hide-scrollbars", "--remote-debugging-pipe",
)  # fmt: skip
# The browser wants its pipes as 3 and 4; subprocess alone cannot renumber them.
RENUMBER = """
import os, sys
os.dup2(int(sys.argv[1]), 3)
os.dup2(int(sys.argv[2]), 4)
os.execvp(sys.argv[3], sys.argv[3:])
"""
LEAST_FREE = 10  # so that renumbering overwrites neither pipe
BECOMES_S = 20.0


def find_chromium() -> str | None:
    """The browser's command, None where this machine has none."""
    return next((path for path in map(shutil.which, NAMES) if path), None)


class Page:
    """One tab. `events` keeps all that the browser said of it, `requests` each address that it asked for."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._to, self._from = to_browser, from_browser
        self._buffer = b""
        self._number = 0
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def open(self, path: Path, width: int = 1440, height: int = 1000, *, dark: bool = False) -> None:
        """Show a file in a window of that size, and wait until it is loaded and drawn once."""
        self.events.clear()
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
                  mobile=width < 600)  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media="", features=[scheme])
        self.call("Page.navigate", url=path.resolve().as_uri())
        self._wait_for("Page.loadEventFired")
        self.settle()

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression; a promise is waited for. AssertionError where it throws."""
        said = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in said, said["exceptionDetails"]
        return said["result"].get("value")

    def becomes(self, condition: str) -> bool:
        """Whether a JavaScript condition comes true: what a click does may be seen a frame later."""
        deadline = time.monotonic() + BECOMES_S
        while not self.run(condition):
            if time.monotonic() > deadline:
                return False
        return True

    def key(self, name: str) -> None:
        for kind in ("keyDown", "keyUp"):
            code = {"ArrowLeft": 37, "ArrowRight": 39}.get(name, 0)
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code)

    def mouse(self, kind: str, x: float, y: float, **members: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **members)

    def touch(self, kind: str, points: list[tuple[float, float]]) -> None:
        touches = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=touches)

    def picture(self, path: Path, *, whole: bool = False) -> Path:
        """A PNG of the window, or of the whole page."""
        said = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(said["data"]))
        return path

    def pdf(self, path: Path) -> Path:
        path.write_bytes(base64.b64decode(self.call("Page.printToPDF", printBackground=True)["data"]))
        return path

    @property
    def complaints(self) -> list[str]:
        """What the console and the page's errors say."""
        names = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        return [json.dumps(event["params"])[:600] for event in self.events if event["method"] in names]

    @property
    def requests(self) -> list[str]:
        return [
            event["params"]["request"]["url"]
            for event in self.events
            if event["method"] == "Network.requestWillBeSent"
        ]

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One command -> its result. AssertionError where the browser refuses it."""
        self._number += 1
        command: dict[str, Any] = {"id": self._number, "method": method, "params": params}
        if self._session:
            command["sessionId"] = self._session
        data = json.dumps(command).encode() + b"\0"
        while data:
            data = data[os.write(self._to, data) :]
        deadline = time.monotonic() + LIMIT_S
        while True:
            message = self._read(deadline)
            if message.get("id") == self._number:
                assert "error" not in message, f"{method}: {message['error']}"
                return message["result"]
            self.events.append(message)

    def _wait_for(self, method: str) -> None:
        deadline = time.monotonic() + LIMIT_S
        while not any(event["method"] == method for event in self.events):
            self.events.append(self._read(deadline))

    def _read(self, deadline: float) -> Any:
        while b"\0" not in self._buffer:
            ready = select.select([self._from], [], [], max(deadline - time.monotonic(), 0))[0]
            assert ready, f"Chromium said nothing for {LIMIT_S:.0f} s"
            data = os.read(self._from, 1 << 20)
            assert data, "Chromium ended"
            self._buffer += data
        message, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(message)


@contextmanager
def chromium(command: str, profile: Path) -> Iterator[Page]:
    """A fresh browser with a profile of its own, ended with all that it started."""
    read_command, write_command = os.pipe()
    read_answer, write_answer = os.pipe()
    ends = [fcntl.fcntl(end, fcntl.F_DUPFD, LEAST_FREE) for end in (read_command, write_answer)]
    with (profile / "chromium.txt").open("wb") as said:
        browser = subprocess.Popen(
            [sys.executable, "-c", RENUMBER, *map(str, ends), command, *FLAGS, f"--user-data-dir={profile}"],
            pass_fds=ends, stdout=said, stderr=said, start_new_session=True,
        )  # fmt: skip
    for end in (read_command, write_answer, *ends):
        os.close(end)
    try:
        yield Page(write_command, read_answer)
    finally:
        os.close(write_command)
        os.close(read_answer)
        os.killpg(browser.pid, signal.SIGKILL)
        browser.wait()
