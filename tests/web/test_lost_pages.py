"""Frozen pages and lost networks: recordings go on, and a page that comes back shows the present state."""

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.web.server import serve_app
from ipsys_log.app.web.setup import SetupApp
from tests.capture.nodes.tcp_relay import Relay
from tests.ports import free_port
from tests.waiting import wait_until
from tests.web.phone import Phone, phone
from tests.web.test_measuring_page import says
from tests.web.test_setup_browser import DESKTOP, Visitor, leave
from tests.web.test_setup_page import SMALL, Client

# Browsers and recordings.
pytestmark = pytest.mark.slow

POINTS = """[[reference_points]]
name = "A"
x_m = 0.0
y_m = 0.0
[[reference_points]]
name = "B"
x_m = 1.0
y_m = 0.0
"""
UNREAD_CONNECTIONS = 6


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Phone]:
    with phone(tmp_path / "first") as one:
        yield one


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "lab"
    path.mkdir()
    return path


@contextmanager
def setup_page(folder: Path, port: int = 0) -> Iterator[Client]:
    setup = SetupApp(LabFolder(folder))
    with serve_app(setup.app, None, port) as server:
        try:
            yield Client(server.url, setup)
        finally:
            setup.session.close()
        assert server.exceptions.count == 0, server.exceptions.first


def renderers(browser: Phone) -> list[int]:
    """Return the processes of the browser that draw pages; they are its children, or theirs."""
    parents = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(status.parent.name)] = int(status.read_text().rpartition(")")[2].split()[1])
        except OSError:  # the process has ended
            continue
    family = {browser.process}
    while more := {one for one, parent in parents.items() if parent in family} - family:
        family |= more
    return [one for one in family if b"--type=renderer" in Path(f"/proc/{one}/cmdline").read_bytes()]


@contextmanager
def frozen(browser: Phone) -> Iterator[None]:
    """Stop the pages of a browser, as an operating system does with a page in the background."""
    stopped = renderers(browser)
    assert stopped
    try:
        for one in stopped:
            os.kill(one, signal.SIGSTOP)
        yield
    finally:
        for one in stopped:
            os.kill(one, signal.SIGCONT)


@contextmanager
def unread(page: Client, *paths: str) -> Iterator[None]:
    """Ask for answers on connections with small buffers, and never read them."""
    with ExitStack() as stack:
        for path in paths * UNREAD_CONNECTIONS:
            lazy = stack.enter_context(socket.socket())
            lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
            lazy.bind(("127.0.0.2", 0))
            lazy.connect((str(page.parts.hostname), page.parts.port))
            lazy.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode() * 20)
        yield


def test_frozen_page_of_a_measuring_does_not_stop_it(browser: Phone, folder: Path) -> None:
    (folder / "lab.toml").write_text(SMALL + POINTS)
    with setup_page(folder) as page:
        page.operate()
        browser.open(page.parts.geturl() + "#points", DESKTOP)
        assert page.ask("/api/start", {"action": "measure"}) == (200, {})
        browser.wait("document.querySelector('#open-measure')")
        with frozen(browser), unread(page, "/api/state", "/panels.js", "/measure/api/views"):
            # The images of the camera go on.
            views = [page.ask("/measure/api/views")]
            for _ in range(3):
                wait_until(lambda: page.ask("/measure/api/views") != views[-1], "another image is shown")
                views.append(page.ask("/measure/api/views"))
            assert page.ask("/api/stop", {}) == (200, {})
            assert page.job_ended()["error"] == ""
        # The page shows the end of the measuring, and its buttons work again.
        browser.wait("document.querySelector('#job').hidden && document.querySelector('#measure')")
        says(browser, "#panel", "0 points measured")
        says(browser, "#operation", "Another device operates")
        browser.tap("#take")
        says(browser, "#operation", "This device operates")
        browser.wait("!document.querySelector('#measure').disabled")
        leave(browser)


def test_page_shows_the_present_state_after_a_lost_network(browser: Phone, folder: Path) -> None:
    with setup_page(folder) as page, Relay(page.parts.port or 0) as relay:
        browser.open(f"http://127.0.0.1:{relay.port}/", DESKTOP)
        says(browser, "#state", "0 of 8")
        relay.cut(closes=False)
        says(browser, "#state", "ipsys does not answer")
        says(browser, "#operation", "the buttons wait")
        browser.wait("document.querySelector('#save').disabled")
        # Meanwhile another device uses the simulated lab.
        page.operate()
        assert page.ask("/api/simulate", {}) == (200, {})
        assert page.ask("/api/operate", {"release": page.operator}) == (200, {})
        relay.mend()
        says(browser, "#state", "3 of 8")
        says(browser, "#panel", "simulated_lab")
        browser.wait("!document.querySelector('#save').disabled")
        browser.run("document.querySelector('#name').value = 'hall'")
        browser.tap("#save")
        says(browser, "#panel", "hall: DICT")
        leave(browser)


def test_page_goes_on_when_the_command_is_started_again(browser: Phone, folder: Path) -> None:
    port = free_port()
    with setup_page(folder, port) as page:
        browser.open(page.parts.geturl(), DESKTOP)
        Visitor(browser).tap("#simulate")
        says(browser, "#state", "3 of 8")
    says(browser, "#state", "ipsys does not answer")
    with setup_page(folder, port):
        says(browser, "#state", "3 of 8")
        # The new server has no operator: this device operates by its next change.
        browser.run("document.querySelector('#name').value = 'hall'")
        browser.tap("#save")
        says(browser, "#panel", "hall: DICT")
        says(browser, "#operation", "This device operates")
        leave(browser)
