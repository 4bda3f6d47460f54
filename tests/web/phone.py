"""A phone: headless Chromium of phone size, controlled by taps and keys through its debugging pipe."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.report.browser import chromium

_WIDTH, _HEIGHT = 390, 844
_PATIENCE_S = 120.0
# Two taps at one point within this time are a double tap.
_DOUBLE_TAP_S = 0.35


class Phone:
    """One page in one browser; ``console`` has the messages of the browser, ``process`` is its process."""

    def __init__(self, read: int, write: int, process: int) -> None:
        self._read, self._write, self.process = read, write, process
        self._rest = b""
        self._number = 0
        self._session: str | None = None
        self.console: list[str] = []
        self._tapped_s = 0.0

    def send(self, method: str, **given: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol; return its result."""
        answer = self._answer(method, given)
        assert "error" not in answer, answer
        result: dict[str, Any] = answer["result"]
        return result

    def _answer(self, method: str, given: dict[str, Any]) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": given}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                return answer

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            data = os.read(self._read, 1 << 16)
            assert data, "the browser has gone"
            self._rest += data
        one, _, self._rest = self._rest.partition(b"\0")
        answer: dict[str, Any] = json.loads(one)
        if answer.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown"):
            self.console.append(json.dumps(answer["params"]))
        return answer

    def open(self, url: str, size_px: tuple[int, int] = (_WIDTH, _HEIGHT), scheme: str = "light") -> None:
        """Open a page in a window of this size, in a colour scheme that the user prefers."""
        self._session = None
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        width, height = size_px
        is_phone = size_px == (_WIDTH, _HEIGHT)
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=2 if is_phone else 1, mobile=is_phone,
        )  # fmt: skip
        self.prefer(scheme)
        self.send("Emulation.setTouchEmulationEnabled", enabled=True)
        # Keys go to a page with the focus, also on a busy machine.
        self.send("Emulation.setFocusEmulationEnabled", enabled=True)
        for domain in ("Log", "Runtime", "Page"):
            self.send(f"{domain}.enable")
        self.send("Page.navigate", url=url)
        self.wait("location.href !== 'about:blank' && document.readyState === 'complete'")

    def reload(self) -> None:
        """Load the page again, and wait until its document is complete."""
        self.run("window.isOld = true")
        self.send("Page.reload")
        end = time.monotonic() + _PATIENCE_S
        given = {"expression": "!window.isOld && document.readyState === 'complete'", "returnByValue": True}
        # In between there is no document, and an expression has no context.
        while not self._answer("Runtime.evaluate", given).get("result", {}).get("result", {}).get("value"):
            assert time.monotonic() < end, "the page is not complete"
            time.sleep(0.05)

    def prefer(self, scheme: str) -> None:
        """Change the colour scheme that the user prefers; colours change at once."""
        preferred = {"prefers-color-scheme": scheme, "prefers-reduced-motion": "reduce"}
        features = [{"name": name, "value": value} for name, value in preferred.items()]
        self.send("Emulation.setEmulatedMedia", features=features)

    def run(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, script: str) -> None:
        """Wait until an expression is true in the page."""
        script = f"Boolean({script})"
        end = time.monotonic() + _PATIENCE_S
        while not self.run(script):
            assert time.monotonic() < end, f"{script}: never, but {self.state()}"
            time.sleep(0.05)

    def tap(self, selector: str) -> None:
        """Tap the centre of an element, which must not be covered."""
        found = json.dumps(selector)
        time.sleep(max(self._tapped_s + _DOUBLE_TAP_S - time.monotonic(), 0.0))
        x, y, hit = self.run(
            f"(async () => {{ const e = document.querySelector({found});"
            "e.scrollIntoView({block: 'center'});"
            # The tap waits until the element stops moving.
            "let b = {}, still = 0; while (still < 6) { await new Promise(requestAnimationFrame);"
            "const now = e.getBoundingClientRect(); still = now.x === b.x && now.y === b.y ? still + 1 : 0;"
            "b = now; } const x = b.x + b.width / 2, y = b.y + b.height / 2;"
            "const there = document.elementFromPoint(x, y);"
            "return [x, y, there === e || e.contains(there) || there.contains(e)]; })()"
        )
        assert hit, f"{selector} is covered"
        self._tapped_s = time.monotonic()
        self.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def type(self, selector: str, text: str) -> None:
        """Type a text key by key into a tapped field."""
        self.tap(selector)
        self.wait(f"document.activeElement === document.querySelector({json.dumps(selector)})")
        for key in text:
            # A bare "char" may be lost: the browser can ignore all events up to the next "keyDown".
            self.send("Input.dispatchKeyEvent", type="keyDown", text=key, key=key)
            self.send("Input.dispatchKeyEvent", type="keyUp", key=key)
        self.wait(f"document.querySelector({json.dumps(selector)}).value.endsWith({json.dumps(text)})")

    def text(self, selector: str = "body") -> str:
        return str(self.run(f"document.querySelector({json.dumps(selector)}).innerText"))

    def state(self) -> str:
        """Return the text of the page, its fields, its focus, and the messages of the browser."""
        fields = self.run(
            "JSON.stringify([document.activeElement?.id, document.hasFocus(),"
            "...[...document.querySelectorAll('input')].map((e) => [e.id, e.value])])"
        )
        return f"{self.text()}\n{fields}\n{self.console}"

    def picture(self, path: Path) -> None:
        """Save the whole page as an image."""
        data = self.send("Page.captureScreenshot", captureBeyondViewport=True, format="png")["data"]
        path.write_bytes(base64.b64decode(data))


@contextmanager
def phone(folder: Path) -> Iterator[Phone]:
    """Start a browser without any network except this machine's."""
    there, write = os.pipe()
    read, here = os.pipe()
    # The numbers avoid the two numbers that the browser uses.
    ours = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 20) for end in (there, here)]
    for end in (there, here):
        os.close(end)
    command = [
        "bash", "-c", f'exec "$@" 3<&{ours[0]} 4>&{ours[1]}', "bash", chromium(), "--headless=new",
        "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost",
        f"--user-data-dir={folder / 'profile'}", "about:blank",
    ]  # fmt: skip
    with subprocess.Popen(command, pass_fds=ours, stderr=subprocess.DEVNULL) as browser:
        for end in ours:
            os.close(end)
        try:
            yield Phone(read, write, browser.pid)
        finally:
            browser.kill()
            os.close(read)
            os.close(write)
