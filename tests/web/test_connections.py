"""Connections to the measuring page: bounded in number and time, without effect on a recording."""

import errno
import http.client
import json
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from inspect import getsource, signature
from pathlib import Path
from typing import TypeVar

import pytest
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.server import ServerState

from ipsys_log.app.cli.pages import say_faults
from ipsys_log.app.web.app import build_app
from ipsys_log.app.web.server import PageLimits, PageServer, ServerExceptions, derive_limits, serve_app
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.scene import CameraView
from ipsys_log.log.dataset import Session
from tests.test_measure_now import Lab, still_lab
from tests.waiting import wait_until
from tests.web.test_access import Caller
from tests.web.test_measuring_page import Recording

__all__ = ["still_lab"]

PATIENCE_S = 240.0
Answer = TypeVar("Answer")
DESCRIPTORS = 128
# From each of eight addresses.
IDLE_CONNECTIONS = 250
PAGE_S = 2.0


@contextmanager
def connections(caller: Caller, count: int, source: str = "127.0.0.1") -> Iterator[list[socket.socket]]:
    """Plain connections to a page, from one loopback address."""
    address = str(caller.parts.hostname), caller.parts.port or 0
    with ExitStack() as stack:
        yield [
            stack.enter_context(
                socket.create_connection(address, timeout=PATIENCE_S, source_address=(source, 0))
            )
            for _ in range(count)
        ]


@contextmanager
def recording(lab: Lab, log: Path) -> Iterator[tuple[subprocess.Popen[str], Caller, Path]]:
    """A recorder with its page and few descriptors, after the detection of markers."""
    errors = log.with_suffix(".stderr")
    command = ["bash", "-c", f'ulimit -n {DESCRIPTORS}; exec "$@"', "bash", sys.executable, "-m", "ipsys_log"]
    command += ["record", "-o", str(log), "--rig", str(lab.rig), "--calibration", str(lab.lenses)]
    command += ["--measure", "--host", "127.0.0.1", "--port", "0"]
    with (
        errors.open("w") as stderr,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr, text=True) as program,
    ):
        try:
            wait_until(
                lambda: program.poll() is not None or "measure at " in errors.read_text(),
                "the recorder prints the address of its page",
                errors.read_text,
            )
            match = re.search(r"measure at (\S+)", errors.read_text())
            assert match, errors.read_text()
            yield program, Caller(match[1]), errors
        finally:
            program.kill()


def sign_in(caller: Caller) -> str:
    """Open the page by its full address; return its cookie."""
    status, _, headers = caller.ask("GET", f"/?token={caller.token}")
    assert status == 303
    return headers["set-cookie"].split(";")[0]


@pytest.fixture
def many_descriptors() -> Iterator[None]:
    """Let this process open 4,096 files; the recorder has fewer."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 4096), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


# 2,000 connections to a real recorder.
@pytest.mark.slow
@pytest.mark.usefixtures("many_descriptors")
def test_recorder_survives_idle_connections(still_lab: Lab, tmp_path: Path) -> None:
    log = tmp_path / "session.mcap"
    with recording(still_lab, log) as (program, caller, errors):
        cookie = sign_in(caller)
        wait_until(lambda: log.exists() and log.stat().st_size > 0, "the log is not empty")
        with ExitStack() as stack:
            for number in range(2, 10):
                stack.enter_context(connections(caller, IDLE_CONNECTIONS, f"127.0.0.{number}"))
            before, times_s = log.stat().st_size, []
            for _ in range(10):
                begin_s = time.monotonic()
                assert caller.ask("GET", "/", Cookie=cookie)[0] == 200
                times_s.append(time.monotonic() - begin_s)
            assert sorted(times_s)[5] < PAGE_S
            wait_until(
                lambda: json.loads(caller.ask("GET", "/api/views", Cookie=cookie)[1])["visible"],
                "a marker is visible",
            )
            wait_until(lambda: log.stat().st_size > before, "the log grows")
            program.send_signal(signal.SIGTERM)
            assert program.wait(PATIENCE_S) == 0, errors.read_text()
    assert "Traceback" not in errors.read_text()
    with Session([log]) as session:
        # A busy machine skips frames in processing; all are recorded.
        assert {event.kind for event in session.payloads(["/events"])} <= {"frame_skipped"}
        assert all(session.count(topic) > 5 for topic in session.images.values())


def test_used_private_parts_of_uvicorn_are_unchanged() -> None:
    """A new version of uvicorn may change them: then compare ``server.py`` with its source."""
    assert list(signature(H11Protocol).parameters)[:3] == ["config", "server_state", "app_state"]
    methods = ("connection_made", "connection_lost", "on_response_complete", "send_400_response")
    assert [name for name in methods if not callable(getattr(H11Protocol, name, None))] == []
    of_connection, of_cycle = getsource(H11Protocol), getsource(RequestResponseCycle)
    for name in ("conn", "cycle", "transport", "loop", "client"):
        assert f"self.{name}" in of_connection
    for name in ("response_started", "disconnected", "message_event"):
        assert f"self.{name}" in of_cycle
    server = uvicorn.Server(uvicorn.Config("app"))
    assert isinstance(server.server_state, ServerState)


@contextmanager
def page_with(limits: PageLimits, scene: Recording | None = None) -> Iterator[tuple[Caller, PageServer]]:
    with serve_app(build_app(scene or Recording()), "127.0.0.1", 0, limits) as page:
        yield Caller(page.url), page


def is_open(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except ConnectionError:
        return False


def is_closed_by_page(connection: socket.socket) -> bool:
    """Wait for the end of a connection, and ignore earlier data."""
    connection.settimeout(PATIENCE_S)
    try:
        while connection.recv(1 << 16):
            pass
    except ConnectionError:
        pass
    return True


def test_idle_connections_leave_room_for_a_phone() -> None:
    with page_with(PageLimits(total=6, per_address=4)) as (caller, page):
        with ExitStack() as stack:
            held = [
                connection
                for number in range(1, 6)
                for connection in stack.enter_context(connections(caller, 20, f"127.0.0.{number}"))
            ]
            cookie = sign_in(caller)
            for _ in range(5):
                assert caller.ask("GET", "/api/scene", Cookie=cookie)[0] == 200
            wait_until(lambda: sum(map(is_open, held)) <= 6, "at most 6 connections are open")
        assert page.exceptions.count == 0


def test_phone_keeps_its_connection_beside_new_ones() -> None:
    with page_with(PageLimits(total=6, per_address=4)) as (caller, _):
        phone = http.client.HTTPConnection(
            str(caller.parts.hostname), caller.parts.port or 0, timeout=PATIENCE_S
        )
        with closing(phone):
            headers = {"Cookie": sign_in(caller)}
            phone.request("GET", "/api/scene", headers=headers)
            assert phone.getresponse().read()
            own = phone.sock
            with connections(caller, 30) as held:
                wait_until(lambda: sum(map(is_open, held)) < 6, "fewer than 6 connections are open")
                phone.request("GET", "/api/scene", headers=headers)
                assert phone.getresponse().status == 200
                assert phone.sock is own


SLOW_REQUESTS = [
    b"",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: ",
    b"POST /api/check HTTP/1.1\r\nHost: localhost\r\nX-Ipsys: 1\r\nCookie: COOKIE\r\n"
    b"Content-Length: 900\r\n\r\n{",
    b"POST /api/check HTTP/1.1\r\nHost: localhost\r\nX-Ipsys: 1\r\nCookie: COOKIE\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n1\r\n{\r\n",
    b"GET /api/scene HTTP/1.1\r\nHost: localhost\r\nCookie: COOKIE\r\n\r\n",
    b"GET /api/scene HTTP/1.1\r\nHost: localhost\r\nCookie: COOKIE\r\n\r\nGET / HTTP/1.1\r\nX-Slow: ",
]


def test_slow_requests_are_closed() -> None:
    with page_with(PageLimits(total=12, per_address=8, request_s=0.5)) as (caller, page):
        cookie = in_time(lambda: sign_in(caller)).encode()
        with connections(caller, len(SLOW_REQUESTS)) as slow:
            for connection, start in zip(slow, SLOW_REQUESTS, strict=True):
                with suppress(ConnectionError):  # a busy server has closed it already
                    connection.sendall(start.replace(b"COOKIE", cookie))
            assert all(map(is_closed_by_page, slow))
        assert page.exceptions.count == 0


def in_time(ask: Callable[[], Answer]) -> Answer:
    """Ask until the server answers within its limit: it closes connections that wait for their turn."""
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            return ask()
        except (ConnectionError, http.client.HTTPException):
            assert time.monotonic() < end


def test_unread_answers_are_closed_in_time() -> None:
    scene = Recording()
    scene.views = lambda interval: [CameraView("red", 1, bytes(8 << 20))]  # type: ignore[method-assign]
    with page_with(PageLimits(total=6, per_address=4, request_s=0.5), scene) as (caller, page):
        cookie = in_time(lambda: sign_in(caller))
        assert in_time(lambda: caller.ask("GET", "/api/views", Cookie=cookie))[0] == 200
        request = f"GET /picture/red/1 HTTP/1.1\r\nHost: localhost\r\nCookie: {cookie}\r\n\r\n".encode()
        with connections(caller, 4) as lazy:
            for connection in lazy:
                with suppress(ConnectionError):
                    connection.sendall(request)
                    connection.recv(1)
            assert in_time(lambda: sign_in(caller))
        assert page.exceptions.count == 0


def test_noise_on_the_port_stays_off_the_screen(capfd: pytest.CaptureFixture[str]) -> None:
    with page_with(PageLimits(total=6, per_address=4)) as (caller, page):
        post = b"POST / HTTP/1.1\r\nHost: localhost\r\nx-ipsys: 1\r\n"
        chunk = post + b"Transfer-Encoding: chunked\r\n\r\nwrong\r\n"
        hello = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"
        for noise in (hello, b"GET\r\n\r\n", b"\0" * (1 << 17), chunk):
            with connections(caller, 1) as (noisy,):
                noisy.sendall(noise)
                assert is_closed_by_page(noisy)
        assert sign_in(caller)
        assert page.exceptions.count == 0
    assert capfd.readouterr() == ("", "")


def test_fault_of_the_page_is_kept_for_the_end(capfd: pytest.CaptureFixture[str]) -> None:
    scene = Recording()

    def fail(interval: int | None) -> list[CameraView]:
        raise ZeroDivisionError("a bug")

    scene.views = fail  # type: ignore[method-assign]
    with serve_app(build_app(scene), port=0) as page:
        caller = Caller(page.url)
        for _ in range(2):
            status, text, _ = caller.ask("GET", "/api/views")
            assert status == 500
            assert "ZeroDivisionError: a bug" in json.loads(text)["error"]
        assert caller.ask("GET", "/")[0] == 200
        assert page.exceptions.count == 2
        assert page.exceptions.first.startswith("Traceback")
    assert capfd.readouterr() == ("", "")


def test_faults_are_printed_when_the_command_ends(capsys: pytest.CaptureFixture[str]) -> None:
    faults = ServerExceptions()
    page = PageServer("http://127.0.0.1/", threading.Thread(), faults)
    say_faults(page)
    assert capsys.readouterr() == ("", "")
    for text in ("[first]", "second"):
        faults.add(ExceptionGroup("tasks", [ZeroDivisionError(text)]))
    say_faults(page)
    said = capsys.readouterr().err
    assert "internal errors of the measuring page: 2" in said
    assert said.rstrip().endswith("ZeroDivisionError: [first]")


def test_end_of_the_server_does_not_end_the_block(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    is_broken = threading.Event()

    async def tick(self: uvicorn.Server, counter: int) -> bool:
        if is_broken.is_set():
            raise ZeroDivisionError("a bug")
        return self.should_exit

    monkeypatch.setattr(uvicorn.Server, "on_tick", tick)
    with serve_app(build_app(Recording()), port=0) as page:
        is_broken.set()
        page.thread.join(PATIENCE_S)
        assert not page.thread.is_alive()
        assert page.exceptions.count == 1
        assert page.exceptions.first.endswith("ZeroDivisionError: a bug")
    assert capfd.readouterr() == ("", "")


def test_server_that_does_not_start_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    async def start(self: uvicorn.Server, sockets: object = None) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(uvicorn.Server, "startup", start)
    with (
        pytest.raises(IpsysError, match=r"the page cannot be served: OSError: .* Too many open files"),
        serve_app(build_app(Recording()), port=0),
    ):
        pass


@pytest.mark.parametrize(("descriptors", "total"), [(64, 12), (256, 32), (1024, 64), (1 << 20, 64)])
def test_limits_leave_descriptors_to_the_recorder(
    monkeypatch: pytest.MonkeyPatch, descriptors: int, total: int
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (descriptors, descriptors))
    limits = derive_limits()
    assert limits.total == total
    assert 8 <= limits.per_address < limits.total
