"""Network cameras on the setup page: a real RTSP server, its password, nodes, and faults at their fields."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.web.server import serve_app
from ipsys_log.app.web.setup import SetupApp
from ipsys_log.capture.nodes import centre
from ipsys_log.capture.nodes.network import NodeNetwork
from ipsys_log.messages.rig_file import load_rig
from tests.capture.nodes.lab_of_nodes import sending
from tests.capture.streams import encode, make_jpegs
from tests.capture.test_rtsp import CODECS, HAS_SERVER, served
from tests.playing import WAIT_LIMIT_S
from tests.ports import free_port
from tests.waiting import wait_until
from tests.web.phone import Phone
from tests.web.test_measuring_page import says
from tests.web.test_setup_browser import JOB_ENDED, Visitor, opened
from tests.web.test_setup_page import Client

# Real cameras of the network, and a browser.
pytestmark = pytest.mark.slow

RIG = 'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
needs_server = pytest.mark.skipif(not HAS_SERVER, reason="no RTSP server; see tests/capture/test_rtsp.py")
FIELDS = ("address", "user", "password", "new_name")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "lab"
    path.mkdir()
    (path / "lab.toml").write_text(RIG)
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("network")
    make_jpegs(folder, 150)
    return encode(folder, "h264.mov", *CODECS["h264"])


@contextmanager
def page_of(folder: Path) -> Iterator[Client]:
    setup = SetupApp(LabFolder(folder))
    with serve_app(setup.app, None, 0) as server:
        client = Client(server.url, setup)
        client.operate()
        yield client
        setup.session.close()
        assert server.exceptions.count == 0, server.exceptions.first


def type_address(browser: Phone, address: str, user: str = "", password: str = "") -> None:
    for name, text in zip(FIELDS, (address, user, password), strict=False):
        browser.run(f"document.querySelector('#{name}').value = {json.dumps(text)}")
    browser.tap("#add-camera")


@needs_server
def test_password_of_a_network_camera_is_only_in_the_rig_file(
    video: Path, folder: Path, browser: Phone
) -> None:
    with served(video, "tcp", "digest") as address, opened(browser, folder, (1280, 900)) as url:
        browser.wait("document.querySelector('#step-cameras')")
        browser.run("location.hash = 'cameras'")
        browser.wait("document.querySelector('#add-camera')")
        type_address(browser, "camera on the wall")
        says(browser, "#address-fault", "the address has a space")
        browser.wait("document.activeElement.id === 'address'")
        type_address(browser, address, "admin", "guess")
        says(browser, "#password-fault", "the password is missing or not accepted")
        browser.wait("document.activeElement.id === 'password'")
        # The typed texts are still there to be corrected.
        assert browser.run("document.querySelector('#address').value") == address
        assert (folder / "lab.toml").read_text() == RIG
        type_address(browser, address, "admin", "hush")
        browser.wait("document.querySelector('.image img')?.naturalWidth === 320")
        says(browser, "#panel", address.replace("//", "//admin:***@"))
        assert [browser.run(f"document.querySelector('#{name}').value") for name in FIELDS] == [""] * 4
        (camera,) = load_rig(folder / "lab.toml").cameras
        assert camera.source == address.replace("//", "//admin:hush@")
        assert "hush" not in json.dumps(Client(url).state())
        assert "hush" not in browser.run("document.documentElement.outerHTML")
        # A search uses the password of the rig file.
        Visitor(browser).tap("#pictures")
        browser.wait("document.querySelectorAll('.image img').length === 4")
        browser.wait(JOB_ENDED)
        assert "hush" not in json.dumps(Client(url).state())


def test_camera_of_a_node_is_added_with_its_picture(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(centre, "_FIRST_ANSWER_S", WAIT_LIMIT_S)
    network = NodeNetwork("127.0.0.1", free_port())
    (folder / "lab.toml").write_text(f'{RIG}[nodes]\ncentre = "{network}"\n')
    with sending(tmp_path, network, "ceiling") as feed, page_of(folder) as page:
        ended = threading.Event()

        def record() -> None:
            while not ended.wait(0.1):
                feed.record(1)

        recording = threading.Thread(target=record)
        recording.start()
        try:
            assert page.ask("/api/address", {"values": {"address": "zenoh:ceiling"}}) == (200, {})
            page.job_ended()
        finally:
            ended.set()
            recording.join()
        (camera, *_) = page.state()["cameras"]
        assert (camera["key"], camera["name"]) == ("zenoh:ceiling", "ceiling"), page.state()["address"]
        assert page.ask(f"/{camera['picture']}")[1].startswith(b"ceiling")


def test_stop_ends_the_wait_for_a_node(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Without a stop, the wait is longer than that of this test.
    monkeypatch.setattr(centre, "_FIRST_ANSWER_S", 2 * WAIT_LIMIT_S)
    (folder / "lab.toml").write_text(f'{RIG}[nodes]\ncentre = "127.0.0.1:{free_port()}"\n')
    with page_of(folder) as page:
        assert page.ask("/api/address", {"values": {"address": "zenoh:ceiling"}}) == (200, {})
        wait_until(
            lambda: any("waits for node" in line for line in page.state()["job"]["lines"]),
            "the job waits for its node",
        )
        assert page.ask("/api/stop", {}) == (200, {})
        assert page.job_ended()["error"] == ""
        assert page.state()["address"]["fault"] is None
        assert (folder / "lab.toml").read_text().startswith(RIG)
