"""A headless Chromium that tests drive by the DevTools protocol, over a pair of pipes: no port is
opened."""

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from tests import needs
from tests.patience import HANG_S

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
    "--disable-gpu",
    "--hide-scrollbars",
)
"""Without a GPU: where there is none, its emulation shows five frames a second, and Chromium's own
drawing sixty."""
GRACE_S = 10.0
"""Time to end by itself before it is killed."""


class Browser:
    """One page in Chromium, as a context manager; skips the test where there is no Chromium."""

    def __init__(self, width: int = 1100, height: int = 700) -> None:
        program = next(filter(None, map(shutil.which, NAMES)), None)
        if program is None:
            needs.give_up("chromium", f"none of {', '.join(NAMES)} is on PATH")
        self.size = (width, height)
        self.program = program
        self.complaints: list[str] = []
        """Errors and warnings on the console, and exceptions that nothing caught."""

    def __enter__(self) -> "Browser":
        self.profile = tempfile.mkdtemp(prefix="softfin-chromium-")
        theirs_in, self.write_to = os.pipe()
        self.read_from, theirs_out = os.pipe()
        # The protocol's pipes are its descriptors 3 and 4.
        shell = 'exec "$0" "$@" 3<&%d 4>&%d' % (theirs_in, theirs_out)  # noqa: UP031
        command = [
            self.program,
            *FLAGS,
            "--remote-debugging-pipe",
            f"--user-data-dir={self.profile}",
            "about:blank",
        ]
        self.process = subprocess.Popen(
            ["/bin/bash", "-c", shell, *command],
            pass_fds=(theirs_in, theirs_out),
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self.rest = b""
        self.count = 0
        self.session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.resize(*self.size)
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self.write_to)
        os.close(self.read_from)
        shutil.rmtree(self.profile, ignore_errors=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the protocol, and return its result."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self.write_to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self.count:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def open(self, page: Path, state: str = "") -> None:
        """Open a file, and wait until it has drawn twice."""
        self.visit(f"{page.as_uri()}{state}")

    def visit(self, address: str) -> None:
        """Open an address, and wait until the page has drawn twice."""
        # A change of the state alone would not load the page anew.
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=address)
        self.run(
            "new Promise((done) => document.readyState === 'complete' ? done() : "
            "addEventListener('load', done))"
        )
        self.frames(2)

    def run(self, script: str) -> Any:
        """Value of an expression in the page, that of its promise where it is one."""
        result = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def frames(self, count: int) -> None:
        """Wait for so many frames."""
        self.run(
            f"(async () => {{ for (let k = 0; k < {count}; k++) await new "
            "Promise(requestAnimationFrame); })()"
        )

    def resize(self, width: int, height: int, touch: bool = False) -> None:
        """Show the page at this size, or as on a phone."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=touch,
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=touch)

    def dark(self, dark: bool) -> None:
        """Prefer dark or light colours."""
        value = "dark" if dark else "light"
        self.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": value}],
        )

    def mouse(self, kind: str, x: float, y: float) -> None:
        """Send mousePressed, mouseMoved or mouseReleased, with the left button down."""
        held = {} if kind == "mouseMoved" else {"clickCount": 1}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, **held)

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send touchStart, touchMove or touchEnd."""
        self.call(
            "Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points]
        )

    def press(self, key: str, code: int, shift: bool = False, text: str | None = None) -> None:
        """Press a key and let it go."""
        given: dict[str, Any] = {
            "key": key,
            "windowsVirtualKeyCode": code,
            "modifiers": 8 if shift else 0,
        }
        self.call(
            "Input.dispatchKeyEvent",
            type="keyDown",
            **given,
            **({} if text is None else {"text": text}),
        )
        self.call("Input.dispatchKeyEvent", type="keyUp", **given)

    def screenshot(self, path: Path) -> None:
        """Write what is shown as PNG."""
        path.write_bytes(
            base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        )

    def _read(self) -> dict[str, Any]:
        end = time.monotonic() + HANG_S
        while b"\0" not in self.rest:
            ready, _, _ = select.select([self.read_from], [], [], max(end - time.monotonic(), 0))
            part = os.read(self.read_from, 1 << 20) if ready else b""
            assert part, "Chromium does not answer"
            self.rest += part
        line, _, self.rest = self.rest.partition(b"\0")
        message: dict[str, Any] = json.loads(line)
        self._listen(message.get("method"), message.get("params", {}))
        return message

    def _listen(self, event: str | None, given: dict[str, Any]) -> None:
        if event == "Runtime.exceptionThrown":
            self.complaints.append(str(given["exceptionDetails"]))
        elif event == "Runtime.consoleAPICalled" and given["type"] in ("error", "warning"):
            self.complaints.append(str(given["args"]))
        elif event == "Log.entryAdded" and given["entry"]["level"] in ("error", "warning"):
            self.complaints.append(str(given["entry"]))
