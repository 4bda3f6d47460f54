"""The server of the setup page: faults at fields, refused requests, and one job for all devices."""

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from ipsys_log.app.first_day.jobs import Job
from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.web.server import serve_app
from ipsys_log.app.web.setup import SetupApp
from ipsys_log.messages.rig_file import load_rig
from tests.playing import WAIT_LIMIT_S
from tests.waiting import wait_until

SMALL = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
[[cameras]]
name = "red"
source = "sim:red?stations=0"
width = 480
height = 270
rate_hz = 5
"""


FLOOR = {"width_m": "4.88", "depth_m": "4.88"}


class Client:
    """A client of the setup page, with any headers."""

    def __init__(self, url: str, setup: SetupApp | None = None) -> None:
        self.parts, self.setup = urlsplit(url), setup
        self.cookie: dict[str, str] = {}
        self.operator = 0

    def ask(self, path: str, body: Any = None, **headers: str) -> tuple[int, Any]:
        connection = http.client.HTTPConnection(
            str(self.parts.hostname), self.parts.port or 0, timeout=WAIT_LIMIT_S
        )
        try:
            if isinstance(body, dict):
                body = {"operator": self.operator, **body}
            data = None if body is None else json.dumps(body).encode()
            sent = {"X-Ipsys": "1", **self.cookie, **{k.replace("_", "-"): v for k, v in headers.items()}}
            connection.request("GET" if body is None else "POST", path, data, sent)
            answer = connection.getresponse()
            text = answer.read()
            if cookie := answer.getheader("set-cookie"):
                self.cookie = {"Cookie": cookie.split(";")[0]}
            is_json = "json" in (answer.getheader("content-type") or "")
            return answer.status, json.loads(text) if is_json else text
        finally:
            connection.close()

    def operate(self, take_over: bool = False) -> None:
        """Claim the seat of the operator."""
        status, answer = self.ask("/api/operate", {"take_over": take_over})
        assert status == 200
        self.operator = answer["operator"]

    def state(self) -> dict[str, Any]:
        status, state = self.ask("/api/state")
        assert status == 200
        return dict(state)

    def job_ended(self) -> dict[str, Any]:
        """Wait for the end of the job; return its state."""
        wait_until(lambda: self.state()["job"]["ended"], "the job has ended", lambda: self.state()["job"])
        return dict(self.state()["job"])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "lab"
    path.mkdir()
    return path


@pytest.fixture
def page(folder: Path) -> Iterator[Client]:
    setup = SetupApp(LabFolder(folder))
    with serve_app(setup.app, None, 0, has_viewers=True) as server:
        client = Client(server.url, setup)
        client.operate()
        yield client
        setup.session.close()
        assert server.exceptions.count == 0, server.exceptions.first


def test_typed_rig_is_checked_at_its_fields_and_written(page: Client, folder: Path) -> None:
    values = page.state()["rig"]["values"]
    status, answer = page.ask("/api/rig", {"values": {**values, "marker_length_m": "20"}})
    assert status == 409
    assert [fault["field"] for fault in answer["faults"]] == ["marker_length_m"]
    assert not (folder / "lab.toml").exists()
    assert page.ask("/api/rig", {"values": {**values, "marker_length_m": "0.15"}}) == (200, {})
    assert load_rig(folder / "lab.toml").marker_length_m == 0.15
    status, answer = page.ask("/api/cameras", {"names": {"sim:red": "Red", "sim:white": "mid"}})
    assert (status, [fault["field"] for fault in answer["faults"]]) == (409, ["sim:red"])
    assert page.ask("/api/cameras", {"names": {"sim:red": "red"}}) == (200, {})
    assert page.state()["next"] == "alignment"


def test_restart_continues_where_the_files_are(page: Client, folder: Path) -> None:
    (folder / "lab.toml").write_text(SMALL)
    other = SetupApp(LabFolder(folder))
    with serve_app(other.app, None, 0) as server:
        first, second = page.state(), Client(server.url).state()
        assert {**first, "operator": 0} == second
        assert second["next"] == "alignment"


def test_second_job_is_refused_and_the_operator_stops_the_first(page: Client, folder: Path) -> None:
    (folder / "lab.toml").write_text(SMALL)
    stopped = threading.Event()

    def work(job: Job) -> None:
        job.on_stop(stopped.set)
        stopped.wait()

    assert page.setup is not None
    page.setup.session.jobs.start("the fit", work)
    other = Client(page.parts.geturl())
    assert other.state()["job"]["name"] == "the fit"
    assert "another device operates" in other.ask("/api/stop", {})[1]["error"]
    other.operate(take_over=True)
    for path, body in (("/api/start", {"action": "align"}), ("/api/rig", {"values": {"name": "x"}})):
        status, answer = other.ask(path, body)
        assert (status, "the fit is not finished" in answer["error"]) == (400, True)
    assert other.ask("/api/stop", {}) == (200, {})
    assert page.job_ended()["error"] == ""


# Three simulated cameras are opened.
@pytest.mark.slow
def test_pictures_of_cameras_are_seen_by_all(page: Client, folder: Path) -> None:
    (folder / "lab.toml").write_text(SMALL)
    assert page.ask("/api/start", {"action": "pictures"}) == (200, {})
    assert page.job_ended()["error"] == ""
    other = Client(page.parts.geturl())
    cameras = other.state()["cameras"]
    assert [camera["key"] for camera in cameras] == ["sim:red?stations=0", "sim:white", "sim:black"]
    for camera in cameras:
        status, data = other.ask(f"/{camera['picture']}")
        assert (status, data[:2]) == (200, b"\xff\xd8")


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/api/start", {"action": "rm -r"}),
        ("/api/start", {"action": "live"}),
        ("/api/start", {"action": "sheet"}),
        ("/api/start", []),
        ("/api/calibrate", {"camera": "../red", "options": {"board": "6x4"}}),
        ("/api/calibrate", {"camera": "red", "options": "6x4"}),
        ("/api/intrinsics", {"camera": "../../etc/passwd"}),
        ("/api/cameras", {"names": {"file:/etc/passwd": "red"}}),
        ("/api/cameras", {"names": ["red"]}),
        ("/api/rig", {"values": 3}),
        ("/api/simulate", {}),
    ],
)
def test_impossible_request_is_refused_and_changes_no_file(
    path: str, body: Any, page: Client, folder: Path
) -> None:
    (folder / "lab.toml").write_text(SMALL)
    status, answer = page.ask(path, body)
    assert status == 400
    assert answer["error"]
    assert [one.name for one in folder.iterdir()] == ["lab.toml"]
    assert (folder / "lab.toml").read_text() == SMALL
    assert page.state()["job"] is None


def test_prints_are_pdfs_of_the_markers_and_the_typed_board(page: Client, folder: Path) -> None:
    (folder / "lab.toml").write_text(SMALL)
    status, answer = page.ask("/print/markers.pdf")
    assert (status, "lab.toml lists no markers" in answer["error"]) == (400, True)
    assert page.ask("/api/rig", {"values": {"robots": "3, 4", **FLOOR}}) == (200, {})
    for path in ("/print/markers.pdf", "/print/board.pdf?board=charuco:4x5&square=0.02"):
        status, data = page.ask(path)
        assert (status, data[:5]) == (200, b"%PDF-")
    status, answer = page.ask("/print/board.pdf?board=6")
    assert (status, "--board 6: is not a board" in answer["error"]) == (400, True)
    assert page.ask("/print/lab.toml.pdf")[0] == 400


# A simulated camera records twice.
@pytest.mark.slow
def test_alignment_without_known_markers_names_those_in_the_image(page: Client, folder: Path) -> None:
    """The only marker of the lab moves, so it does not count."""
    small = SMALL.replace("?stations=0", "").replace("480", "960").replace("270", "540")
    (folder / "lab.toml").write_text(f'{small}[[markers]]\nid = 0\nrobot = "ada"\n')
    for is_known in (False, True):
        assert page.ask("/api/start", {"action": "align"}) == (200, {})
        assert page.job_ended()["error"] == ""
        state = page.state()
        (camera,) = state["alignment"]["cameras"]
        (step,) = (step for step in state["steps"] if step["name"] == "alignment")
        assert step["status"] == ("done" if is_known else "ready"), camera
        assert ("image shows markers that lab.toml does not list" in camera["advice"]) is not is_known
        assert ("no result for red" in step["text"]) is not is_known
        # Without ids, all markers of the dictionary count.
        assert page.ask("/api/rig", {"values": {"robots": "", **FLOOR}}) == (200, {})


def test_pictures_have_no_paths(page: Client) -> None:
    for path in ("/picture/alignment/..%2f..%2flab.toml", "/picture/board/1", "/picture/camera/x"):
        assert page.ask(path)[0] == 404


def test_pages_without_their_job_lead_back(page: Client) -> None:
    for path in ("/measure/", "/live/", "/live/api/scene"):
        assert page.ask(path)[0] == 303


def test_foreign_pages_and_hosts_cannot_write(page: Client, folder: Path) -> None:
    assert page.ask("/api/simulate", {}, X_Ipsys="")[0] == 403
    assert page.ask("/api/simulate", {}, Origin="http://evil.example")[0] == 403
    assert page.ask("/api/state", None, Host="evil.example")[0] == 403
    assert list(folder.iterdir()) == []


def test_device_that_may_only_view_sees_and_changes_nothing(folder: Path) -> None:
    setup = SetupApp(LabFolder(folder))
    with serve_app(setup.app, "127.0.0.1", 0, has_viewers=True) as server:
        assert Client(server.url).ask("/api/state")[0] == 403
        for url, may in ((server.view_url, False), (server.url, True)):
            client = Client(str(url))
            assert client.ask(f"/?{client.parts.query}")[0] == 303
            assert client.state()["may_operate"] is may
            if may:
                client.operate()
            status, _ = client.ask("/api/rig", {"values": {}})
            assert (status, (folder / "lab.toml").exists()) == (200 if may else 403, may)


def test_second_device_changes_nothing_until_it_takes_over(page: Client, folder: Path) -> None:
    other = Client(page.parts.geturl())
    for path in ("rig", "simulate", "cameras", "intrinsics", "calibrate", "start", "stop"):
        status, answer = other.ask(f"/api/{path}", {})
        assert (status, "press 'Take over'" in answer["error"]) == (400, True), path
    assert "another device operates" in other.ask("/api/operate", {})[1]["error"]
    assert list(folder.iterdir()) == []
    assert page.state()["operator"] == other.state()["operator"] == page.operator
    other.operate(take_over=True)
    assert other.ask("/api/simulate", {}) == (200, {})
    assert page.ask("/api/start", {"action": "align"})[0] == 400
    assert page.ask("/api/operate", {"release": page.operator}) == (200, {})  # it operates no more
    assert other.state()["operator"] == other.operator


def test_device_of_an_earlier_server_does_not_operate(folder: Path) -> None:
    numbers = set()
    for _ in range(2):
        setup = SetupApp(LabFolder(folder))
        with serve_app(setup.app, None, 0) as server:
            client = Client(server.url)
            client.operate()
            numbers.add(client.operator)
    assert len(numbers) == 2


@pytest.mark.parametrize(
    ("field", "text", "fault"),
    [
        ("board", "6", "--board 6: is not a board"),
        ("square", "3 cm", "--square 3 cm: is not a number"),
        ("square", "20", "--square 20: is not a length"),
        ("lens", "ideal", "--lens ideal: is not known"),
        ("marker_scale", "2", "--marker-scale 2: is not between 0 and 1"),
        ("dictionary", "DICT_1X1", "--dictionary DICT_1X1: is unknown to OpenCV"),
    ],
)
def test_option_of_the_board_is_checked_at_its_field(
    page: Client, folder: Path, field: str, text: str, fault: str
) -> None:
    (folder / "lab.toml").write_text(SMALL)
    options = {"board": "charuco:4x5", field: text}
    status, answer = page.ask("/api/calibrate", {"camera": "red", "options": options})
    assert (status, answer["faults"][0]["field"]) == (409, field)
    assert answer["faults"][0]["text"].startswith(fault)
    assert not (folder / "boards").exists()
