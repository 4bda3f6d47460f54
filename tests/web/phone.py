"""A phone: headless Chromium of phone size, controlled by taps and keys through its debugging pipe."""

import base64
import fcntl
import json
import os
import select
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from tests.report.browser import chromium
from tests.waiting import wait_until

_WIDTH, _HEIGHT = 390, 844
_PATIENCE_S = 240.0
# Two taps at one point within this time are a double tap.
_DOUBLE_TAP_S = 0.35
# A tap without a click in this time is lost: the button was just disabled, or the tap was a long press.
_CLICK_S = 10.0

# Scroll to an element, and wait until it does not move. Return the point of a tap, and whether the element is
# uncovered; or null if the page has replaced or disabled the element. `window.tap` notes the next click.
_AIM = """(async () => {
  const selector = SELECTOR, e = document.querySelector(selector);
  if (!e) return null;
  e.scrollIntoView({block: "center"});
  let b = {}, still = 0;
  while (still < 6) {
    await new Promise(requestAnimationFrame);
    const now = e.getBoundingClientRect();
    still = now.x === b.x && now.y === b.y ? still + 1 : 0;
    b = now;
  }
  if (!e.isConnected || e.disabled) return null;
  const x = b.x + b.width / 2, y = b.y + b.height / 2, there = document.elementFromPoint(x, y);
  const tap = window.tap = {number: NUMBER, hits: null};
  document.addEventListener("click", ({target}) => {
    tap.hits ??= target === there || e.contains(target) || target.closest(selector) !== null;
  }, {capture: true, once: true});
  return [x, y, there === e || e.contains(there) || there.contains(e)];
})()"""


class Phone:
    """One page in one browser; ``console`` has the messages of the page, ``process`` is the browser."""

    def __init__(self, read: int, write: int, process: int) -> None:
        self._read, self._write, self.process = read, write, process
        self._rest = b""
        self._number = 0
        self._answers: dict[int, dict[str, Any]] = {}
        self._session: str | None = None
        self._context: dict[str, str] = {}
        self.console: list[str] = []
        self._tapped_s = 0.0

    def send(self, method: str, **given: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol; return its result."""
        answer = self._answer(method, given)
        assert "error" not in answer, answer
        result: dict[str, Any] = answer["result"]
        return result

    def _answer(self, method: str, given: dict[str, Any]) -> dict[str, Any]:
        return self._await(self._post(method, given))

    def _post(self, method: str, given: dict[str, Any]) -> int:
        """Send a command without waiting for its answer; return its number."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": given}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        return self._number

    def _await(self, number: int) -> dict[str, Any]:
        while number not in self._answers:
            self._receive()
        return self._answers.pop(number)

    def _receive(self) -> None:
        """Receive one message of the browser: an answer, or an event."""
        while b"\0" not in self._rest:
            assert select.select([self._read], [], [], _PATIENCE_S)[0], "the browser does not answer"
            data = os.read(self._read, 1 << 16)
            assert data, "the browser has gone"
            self._rest += data
        one, _, self._rest = self._rest.partition(b"\0")
        answer: dict[str, Any] = json.loads(one)
        is_report = answer.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown")
        if is_report and answer.get("sessionId") == self._session:  # not those of a page of an earlier test
            self.console.append(json.dumps(answer["params"]))
        if "id" in answer:
            self._answers[answer["id"]] = answer

    def open(self, url: str, size_px: tuple[int, int] = (_WIDTH, _HEIGHT), scheme: str = "light") -> None:
        """Open a page in a window of this size, in a colour scheme that the user prefers."""
        self._session = None
        target = self.send("Target.createTarget", url="about:blank", **self._context)["targetId"]
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

    @contextmanager
    def separate(self) -> Iterator[None]:
        """Begin without cookies and messages; close all pages and forget the cookies at the end."""
        self._session = None
        self._context = {"browserContextId": self.send("Target.createBrowserContext")["browserContextId"]}
        self.console.clear()
        try:
            yield
        finally:
            self._session = None
            self.send("Target.disposeBrowserContext", **self._context)
            self._context = {}

    def reload(self) -> None:
        """Load the page again, and wait until its document is complete."""
        self.run("window.isOld = true")
        self.send("Page.reload")
        self.wait("!window.isOld && document.readyState === 'complete'")

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
        wait_until(partial(self.holds, script), script, self.state)

    def holds(self, script: str) -> bool:
        """Return whether an expression is true now.

        It is not true without a document between two pages, and without an element that it reads.
        """
        given = {"expression": f"Boolean({script})", "returnByValue": True, "awaitPromise": True}
        return (
            self._answer("Runtime.evaluate", given).get("result", {}).get("result", {}).get("value") is True
        )

    def tap(self, selector: str) -> None:
        """Tap the centre of an element as soon as it is shown and enabled; it must not be covered.

        A page that is redrawn in between may move or replace the element: then the tap is repeated.
        """
        end = time.monotonic() + _PATIENCE_S
        while not self._tap_once(selector):
            assert time.monotonic() < end, f"{selector}: no tap reaches it, but {self.state()}"

    def _tap_once(self, selector: str) -> bool:
        """Tap an element; return whether the page got the click."""
        found = json.dumps(selector)
        self.wait(f"(e => !e.disabled && e.checkVisibility())(document.querySelector({found}))")
        time.sleep(max(self._tapped_s + _DOUBLE_TAP_S - time.monotonic(), 0.0))
        aim = _AIM.replace("SELECTOR", found).replace("NUMBER", str(number := self._number))
        if (place := self.run(aim)) is None:
            return False
        x, y, is_uncovered = place
        assert is_uncovered, f"{selector} is covered"
        self._tapped_s = time.monotonic()
        # Both parts are sent at once: a pause between them would make it a long press.
        points: list[Any] = [[{"x": x, "y": y}], []]
        sent = [
            self._post("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})
            for kind, touches in zip(("touchStart", "touchEnd"), points, strict=True)
        ]
        for one in sent:
            answer = self._await(one)
            assert "error" not in answer, answer
        return self._is_clicked(number)

    def _is_clicked(self, number: int) -> bool:
        """Wait for the click of a tap; return whether it was on the element."""
        end = time.monotonic() + _CLICK_S
        while time.monotonic() < end:
            # A click that opens another page leaves no note.
            if self.holds(f"window.tap?.number !== {number} || tap.hits"):
                return True
            if self.holds("tap.hits === false"):
                return False
            time.sleep(0.02)
        return False

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
