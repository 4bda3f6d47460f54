"""The server of the dashboard: access, one operator, and pages that cannot affect a recording."""

import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import pytest
import simplejpeg

from ipsys_log.app.cli.pages import serve_dashboard
from ipsys_log.app.web.dashboard.operator import Operator
from ipsys_log.app.web.dashboard.state import Dashboard, DashboardSetting
from ipsys_log.app.web.server import PageLimits
from ipsys_log.engine.request import Request
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Event, Latency, Message, Tracks
from ipsys_log.messages.channels import EVENTS, RIG
from ipsys_log.messages.events import MARK, SEGMENT_ENDED, SEGMENT_STARTED
from tests.live_recordings import again, attached_in_steps, lenses, sent
from tests.playing import WAIT_LIMIT_S
from tests.web.dashboards import BEGIN_NS, LiveLab, event, frame, markers, page_of, robot, tracks
from tests.web.test_access import Caller

ACTIONS = {
    "/api/operate": {},
    "/api/mark": {"operator": 1, "text": "now"},
    "/api/segment": {"operator": 1, "start": "warm-up"},
}


@pytest.fixture
def lab(tmp_path: Path) -> LiveLab:
    return LiveLab(tmp_path / "monday.mcap")


def post(caller: Caller, path: str, body: Any, **headers: str) -> tuple[int, Any]:
    status, text, _ = caller.ask("POST", path, body, X_Ipsys="1", **headers)
    return status, json.loads(text) if text.startswith("{") else text


def cookie_of(url: str) -> dict[str, str]:
    """Open a page by its full address; return its cookie."""
    caller = Caller(url)
    status, _, headers = caller.ask("GET", f"/?token={caller.token}")
    assert (status, headers["location"]) == (303, "/")
    return {"Cookie": headers["set-cookie"].split(";")[0]}


class Reader:
    """A client of the stream of events. As a browser, it asks for the next stream after the end of one."""

    def __init__(self, url: str, source: str = "127.0.0.1", **headers: str) -> None:
        parts = urlsplit(url)
        self.connection = http.client.HTTPConnection(
            str(parts.hostname), parts.port or 0, timeout=WAIT_LIMIT_S, source_address=(source, 0)
        )
        self._headers = headers
        self._ask()

    def _ask(self) -> None:
        self.connection.request("GET", "/api/live", headers=self._headers)
        self.answer = self.connection.getresponse()
        assert self.answer.status == 200

    def lines(self) -> Iterator[bytes]:
        """Yield the lines of all streams."""
        while True:
            try:
                yield from iter(self.answer.readline, b"")
            except (http.client.HTTPException, ConnectionError):
                self.connection.close()  # a very slow server: the answer has reached its limit
            self._ask()

    def next(self, name: str) -> Any:
        """Return the next data of a kind."""
        lines = self.lines()
        next(line for line in lines if line.strip() == f"event: {name}".encode())
        return json.loads(next(lines).removeprefix(b"data: "))

    def until(self, name: str, condition: Callable[[Any], object]) -> Any:
        """Return the next data of a kind that fulfil a condition."""
        while not condition(data := self.next(name)):
            pass
        return data

    def close(self) -> None:
        self.connection.close()


def test_page_of_this_machine_needs_no_secret_and_operates(lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page:
        assert (page.url.startswith("http://127.0.0.1:"), page.view_url) == (True, None)
        caller = Caller(page.url)
        assert caller.token == ""
        assert caller.ask("GET", "/")[0] == 200
        assert json.loads(caller.ask("GET", "/api/scene")[1])["may_operate"] is True
        status, answer = post(caller, "/api/operate", {})
        assert (status, answer["operator"]) == (200, lab.operator.seat.number)


def test_viewer_sees_everything_and_changes_nothing(lab: LiveLab) -> None:
    lab.feed(frame(BEGIN_NS), frame(BEGIN_NS + 10**9), markers(BEGIN_NS + 10**9))
    with page_of(lab.dashboard, "127.0.0.1") as page:
        assert page.view_url is not None
        assert Caller(page.url).token != Caller(page.view_url).token
        caller, viewer, operator = Caller(page.url), cookie_of(page.view_url), cookie_of(page.url)
        number = post(caller, "/api/operate", {}, **operator)[1]["operator"]
        for cookie, may_operate in ((viewer, False), (operator, True)):
            assert json.loads(caller.ask("GET", "/api/scene", **cookie)[1])["may_operate"] is may_operate
            assert caller.ask("GET", f"/picture/red/{BEGIN_NS + 10**9}", **cookie)[0] == 200
        for path, body in ACTIONS.items():
            status, text = post(caller, path, {**body, "operator": number}, **viewer)
            assert (status, "may only view" in text) == (403, True), path
        assert (lab.operator.seat.number, lab.written) == (number, [])
        # A browser that opened both addresses is an operator.
        both = {"Cookie": f"{viewer['Cookie']}; {operator['Cookie']}"}
        assert post(caller, "/api/mark", {"operator": number, "text": "now"}, **both)[0] == 200
        reader = Reader(page.url, **viewer)
        with closing(reader):
            assert reader.next("status")["operator"] == number


def test_other_sites_and_foreign_names_are_refused(lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page:
        caller = Caller(page.url)
        for path in ("/", "/api/scene", "/api/live"):
            assert caller.ask("GET", path, Host="evil.example")[0] == 403
        for path, body in ACTIONS.items():
            assert caller.ask("POST", path, body)[0] == 403
            assert post(caller, path, body, Origin="http://evil.example")[0] == 403
            assert post(caller, path, body, Host="evil.example")[0] == 403
            assert caller.ask("GET", path)[0] == 405
    assert lab.written == []


def test_one_device_operates_until_another_takes_over(lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page:
        caller = Caller(page.url)
        first = post(caller, "/api/operate", {})[1]["operator"]
        status, refusal = post(caller, "/api/operate", {})
        assert (status, "another device operates" in refusal["error"]) == (400, True)
        assert post(caller, "/api/mark", {"operator": first, "text": "one"})[0] == 200
        second = post(caller, "/api/operate", {"take_over": True})[1]["operator"]
        assert "another device operates" in post(caller, "/api/mark", ACTIONS["/api/mark"])[1]["error"]
        post(caller, "/api/operate", {"release": first})
        assert post(caller, "/api/mark", {"operator": second, "text": "two"})[0] == 200
        post(caller, "/api/operate", {"release": second})
        assert post(caller, "/api/mark", {"operator": second, "text": "three"})[0] == 400
        assert post(caller, "/api/operate", {})[0] == 200
    assert [written.text for written in lab.written] == ["one", "two"]


def test_segment_is_started_once_and_ended_with_its_times(lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page:
        caller = Caller(page.url)
        operate = {"operator": post(caller, "/api/operate", {})[1]["operator"]}
        assert "no segment has started" in post(caller, "/api/segment", operate)[1]["error"]
        assert post(caller, "/api/segment", {**operate, "start": " warm-up\n1 "})[0] == 200
        lab.run(5)
        status, refusal = post(caller, "/api/segment", {**operate, "start": "other"})
        assert (status, "warm-up 1 has not ended" in refusal["error"]) == (400, True)
        with closing(Reader(page.url)) as reader:
            assert reader.next("status")["segment"] == {"name": "warm-up 1", "seconds": 5}
        assert post(caller, "/api/segment", operate)[0] == 200
    end_ns = BEGIN_NS + 5 * 10**9
    assert lab.written == [
        Event(BEGIN_NS, SEGMENT_STARTED, "segment warm-up 1 started", start=BEGIN_NS, segment="warm-up 1"),
        Event(
            end_ns, SEGMENT_ENDED, "segment warm-up 1 ended", start=BEGIN_NS, end=end_ns, segment="warm-up 1"
        ),
    ]


WRONG = (
    ("/api/mark", {"text": ""}),
    ("/api/mark", {"text": " \n "}),
    ("/api/mark", {"text": "x" * 201}),
    ("/api/mark", {"text": "now", "operator": True}),
    ("/api/mark", {"text": "now", "operator": "1"}),
    ("/api/mark", b"{"),
    ("/api/mark", b"[]"),
    ("/api/segment", {"start": "x" * 41}),
    ("/api/segment", {"start": ""}),
    ("/api/operate", b"x" * 20_000),
)


def test_wrong_request_is_refused_with_one_sentence(lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page:
        caller = Caller(page.url)
        number = post(caller, "/api/operate", {})[1]["operator"]
        for path, body in WRONG:
            given = body if isinstance(body, bytes) else {"operator": number, **body}
            status, refusal = post(caller, path, given)
            assert (status, "\n" in refusal["error"]) == (400, False), body
    assert lab.written == []


def test_text_of_a_mark_cannot_control_the_terminal(lab: LiveLab) -> None:
    number = lab.operator.seat.claim(False)
    lab.operator.mark(number, "a\x1b]0;b\x07 \u202e c")
    assert [written.text for written in lab.written] == ["a\\x1b]0;b\\x07 \\u202e c"]
    assert lab.said == ["mark: a\\x1b]0;b\\x07 \\u202e c"]


def test_mark_after_the_end_is_refused_with_the_reason() -> None:
    def ended(topic: str, payload: Any) -> None:
        raise IpsysError("not saved: the recording has ended")

    operator = Operator(ended, lambda: BEGIN_NS, print)
    with pytest.raises(IpsysError, match="the recording has ended"):
        operator.start_segment(operator.seat.claim(False), "warm-up")
    assert operator.segment is None


def test_picture_is_served_as_long_as_it_is_kept(lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page:
        caller = Caller(page.url)
        for n in range(30):
            lab.feed(frame(BEGIN_NS + n * 10**9), markers(BEGIN_NS + n * 10**9))
        newest = f"/picture/red/{BEGIN_NS + 29 * 10**9}"
        connection = http.client.HTTPConnection(str(caller.parts.hostname), caller.parts.port or 0)
        with closing(connection):
            connection.request("GET", newest)
            answer = connection.getresponse()
            assert answer.getheader("content-type") == "image/jpeg"
            assert simplejpeg.decode_jpeg(answer.read()).shape == (180, 320, 3)
        assert caller.ask("GET", f"/picture/red/{BEGIN_NS}")[0] == 204
        assert caller.ask("GET", "/picture/none/1")[0] == 204
        assert caller.ask("GET", "/picture/red/x")[0] == 404


def test_news_reach_all_pages_and_the_end_closes_them(lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page, ExitStack() as stack:
        readers = [stack.enter_context(closing(Reader(page.url, f"127.0.0.{2 + n}"))) for n in range(10)]
        for reader in readers:
            assert reader.next("robots")["robots"] == []
            reader.next("status")
        lab.feed(tracks(BEGIN_NS, robot(0, 1.5, 1.0)), event(BEGIN_NS, "camera_lost", "gone", "red"))
        for reader in readers:
            assert reader.until("robots", lambda data: data["robots"])["robots"][0]["x"] == 1.5
            events = reader.until("status", lambda data: data["events"])["events"]
            assert [row["text"] for row in events] == ["gone"]
        lab.end()
        for reader in readers:
            reader.until("status", lambda data: data["end"] == "ended")
            assert reader.answer.read().strip() == b""


def test_connection_of_a_page_ends_after_the_limit(lab: LiveLab) -> None:
    with page_of(lab.dashboard, limits=PageLimits(12, 8, request_s=1.0)) as page, ExitStack() as stack:
        parts = urlsplit(page.url)
        received, end_s = bytearray(), time.monotonic() + WAIT_LIMIT_S
        # A busy server may reach the limit before its first event: then this client asks again.
        while b"event: status" not in received:
            assert time.monotonic() < end_s, bytes(received)
            address = str(parts.hostname), parts.port or 0
            silent = stack.enter_context(socket.create_connection(address, WAIT_LIMIT_S))
            received.clear()
            with suppress(ConnectionError):
                silent.sendall(b"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                while data := silent.recv(1 << 16):
                    received += data
        assert not received.endswith(b"0\r\n\r\n")  # the answer is cut, it has not ended


def test_new_connections_do_not_end_a_stream(lab: LiveLab) -> None:
    limits = PageLimits(12, 8)
    with page_of(lab.dashboard, limits=limits) as page, ExitStack() as stack:
        readers = [stack.enter_context(closing(Reader(page.url))) for _ in range(4)]
        for reader in readers:
            reader.next("status")
        parts = urlsplit(page.url)
        address = str(parts.hostname), parts.port or 0
        idle = [stack.enter_context(socket.create_connection(address)) for _ in range(limits.per_address)]
        assert Caller(page.url).ask("GET", "/")[0] == 200  # the connections before it are accepted, too
        lab.feed(event(BEGIN_NS, "mark", "now"))
        for reader in readers:
            reader.until("status", lambda data: data["events"])
        assert len(idle) == limits.per_address


class Pages(threading.Thread):
    """Ten pages of a recording: seven read, one never reads, one vanishes, one asks for all pictures."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        self.url, self.pictures = url, 0
        # The kinds of the events that have reached each page.
        self.events: set[tuple[int, str]] = set()
        self.connected = threading.Event()

    def run(self) -> None:
        parts = urlsplit(self.url)
        address = str(parts.hostname), parts.port or 0
        with ExitStack() as stack:
            for n in range(2):
                sock = stack.enter_context(socket.create_connection(address, source_address=("127.0.0.2", 0)))
                sock.sendall(b"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                if n:
                    sock.close()
            readers = [stack.enter_context(closing(Reader(self.url, f"127.0.0.{3 + n}"))) for n in range(8)]
            self.connected.set()
            threads = [
                threading.Thread(target=self._read, args=(reader, n)) for n, reader in enumerate(readers)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()

    def _read(self, reader: Reader, number: int) -> None:
        caller = Caller(self.url)
        for line in reader.lines():
            if line.startswith(b"event: "):
                self.events.add((number, line.strip().decode().removeprefix("event: ")))
            elif number == 0 and b'"picture"' in line:
                for tile in json.loads(line.removeprefix(b"data: "))["cameras"]:
                    if "picture" in tile:
                        self.pictures += caller.ask("GET", f"/{tile['picture']}")[0] == 200
            elif b'"end":"ended"' in line:
                break


class Watched(NamedTuple):
    """A recording with ten pages, whose operator writes events after some frames; and the shown messages."""

    log: Path
    pages: Pages
    shown: list[Message]


@pytest.fixture
def watched(lab_log: Path, calibration: Path, tmp_path: Path) -> Watched:
    attached, settings, clock = attached_in_steps(lab_log)
    log, shown = tmp_path / "watched.mcap", list[Message]()
    (rig,) = (message.payload for message in settings if message.topic == RIG.topic)
    with attached:
        operator = Operator(attached.add, clock.now_ns, lambda text: None)
        setting = DashboardSetting(
            rig, lenses(lab_log), None, "poly", attached.states, {}, log, clock.now_ns, ()
        )
        dashboard = Dashboard(setting, operator)
        frames = 0

        def act(message: Message) -> None:
            nonlocal frames
            shown.append(message)
            frames += message.topic.endswith("/image")
            if frames == 20 and operator.seat.number == 0:
                number = operator.seat.claim(False)
                operator.mark(number, "robot pushed")
                operator.start_segment(number, "warm-up")
                operator.end_segment(number)

        with page_of(dashboard) as page:
            pages = Pages(page.url)
            pages.start()
            assert pages.connected.wait(WAIT_LIMIT_S)
            request = Request(model_from=calibration)
            pipeline.live(attached, settings, log, request, None, [clock.watch, act, dashboard])
            pages.join(WAIT_LIMIT_S)
            assert not pages.is_alive()
    return Watched(log, pages, shown)


def test_ten_pages_do_not_change_a_recording(watched: Watched, lab_log: Path) -> None:
    log, pages, shown = watched
    with Session([log]) as session:
        for camera, data in sent(lab_log).items():
            assert [image.data for image in session.payloads([session.images[camera]])] == data
        events = session.payloads(session.topics(EVENTS))
    assert all(one.equal for one in again(log))
    assert pages.events == {(number, name) for number in range(8) for name in ("robots", "status", "tiles")}
    assert pages.pictures > 0
    assert [(one.kind, one.segment) for one in events if one.kind != "frame_skipped"] == [
        (MARK, None),
        (SEGMENT_STARTED, "warm-up"),
        (SEGMENT_ENDED, "warm-up"),
    ]
    # The events and the latencies reach the displays.
    assert [m.payload for m in shown if isinstance(m.payload, Event) and m.payload.kind == MARK] == events[:1]
    positions = sum(isinstance(message.payload, Tracks) for message in shown)
    assert sum(isinstance(message.payload, Latency) for message in shown) == positions > 0


def test_without_a_plan_there_is_no_page(tmp_path: Path) -> None:
    with serve_dashboard(None, None, None, tmp_path, "poly", ()) as dashboards:  # type: ignore[arg-type]
        assert dashboards == []
