"""Typed addresses of cameras: their faults, their names, and passwords with special characters."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.app.first_day.camera_choice import add_camera, parse_camera_address
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.plain_text import hide_password

RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    cameras=(RigCamera("red", source="rtsp://admin:old@10.0.0.7/live", width=1920), RigCamera("white")),
)
FILE = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
[[cameras]]
name = "red"
source = "rtsp://admin:old@10.0.0.7/live"
width = 1920
# The camera above the door.
[[cameras]]
name = "white"
rate_hz = 15
"""


def parsed(**typed: str) -> RigCamera | Fault:
    return parse_camera_address(typed, RIG)


@pytest.mark.parametrize(
    ("typed", "field", "text"),
    [
        ({"address": ""}, "address", "the address is empty; write rtsp://"),
        ({"address": "192.168.1.20"}, "address", "'192.168.1.20' is not the address of a camera"),
        ({"address": "rtsp:/10.0.0.8"}, "address", "'rtsp:/10.0.0.8' is not the address of a camera"),
        ({"address": "rtsp:///live"}, "address", "'rtsp:///live' has no host; write it as"),
        ({"address": "http://10.0.0.8/a b"}, "address", "the address has a space"),
        ({"address": "rtsp://[::1", "user": "x"}, "address", "has no host; write it as"),
        ({"address": "file:/etc/passwd"}, "address", "a page cannot name a file"),
        ({"address": "usb:/dev/video0"}, "address", "a page cannot name a device"),
        ({"address": "usb:999"}, "address", "device '/dev/video999' does not exist"),
        ({"address": "zenoh:../red"}, "address", "the node '../red' must be small letters"),
        ({"address": "concat:/etc/passwd"}, "address", "is not the address of a camera"),
        ({"address": "rtsp://10.0.0.8/", "password": "x"}, "user", "a password needs a user"),
        ({"address": "rtsp://a:b@10.0.0.8/", "user": "x"}, "user", "the address has a user already"),
        ({"address": "zenoh:red", "user": "x"}, "user", "only an address with ://"),
        ({"address": "rtsp://10.0.0.8/", "new_name": "Red"}, "new_name", "camera name 'Red' must be small"),
        ({"address": "rtsp://10.0.0.8/", "new_name": "red"}, "new_name", "two cameras have the name 'red'"),
    ],
)
def test_fault_of_an_address_names_its_field(typed: dict[str, str], field: str, text: str) -> None:
    fault = parsed(**typed)
    assert isinstance(fault, Fault)
    assert fault.field == field
    assert text in fault.text


def test_fault_of_an_address_hides_its_password() -> None:
    fault = parsed(address="rtps://admin:hush@10.0.0.8/live")
    assert isinstance(fault, Fault)
    assert "hush" not in fault.text


@pytest.mark.parametrize(
    ("address", "name"),
    [
        ("rtsp://10.0.0.8/live", "white"),  # the entry without a source
        ("rtsp://admin:new@10.0.0.7/live", "red"),  # the camera with this address
        ("zenoh:ceiling", "ceiling"),
        ("zenoh:red", "white"),  # another camera has the name of the node
    ],
)
def test_camera_without_a_typed_name_gets_a_free_one(address: str, name: str) -> None:
    camera = parsed(address=address)
    assert isinstance(camera, RigCamera)
    assert (camera.name, camera.source) == (name, address)


# "***" marks the missing password of a rig from a log.
@given(st.text(min_size=1).filter(str.strip), st.text().filter(lambda text: text != "***"))
def test_any_password_is_a_part_of_the_address_and_hidden(user: str, password: str) -> None:
    try:
        (user + password).encode()
    except UnicodeEncodeError:  # half of a pair; the server refuses it in a request
        return
    camera = parsed(address="rtsp://10.0.0.8:554/live?channel=1", user=user, password=password)
    assert isinstance(camera, RigCamera)
    parts = urlsplit(str(camera.source))
    assert (parts.hostname, parts.port, parts.path, parts.query) == ("10.0.0.8", 554, "/live", "channel=1")
    assert (unquote(str(parts.username)), unquote(str(parts.password))) == (user.strip(), password)
    assert hide_password(str(camera.source)).endswith(":***@10.0.0.8:554/live?channel=1")


def test_added_camera_keeps_the_settings_and_the_other_cameras(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(FILE)
    red = RigCamera("red", source="rtsp://admin:new@10.0.0.7/live")
    add_camera(path, red)
    add_camera(path, RigCamera("white", source="zenoh:white"))
    add_camera(path, RigCamera("black", source="http://10.0.0.9/video"))
    assert load_rig(path).cameras == (
        RigCamera("red", source=red.source, width=1920),
        RigCamera("white", source="zenoh:white", rate_hz=15),
        RigCamera("black", source="http://10.0.0.9/video"),
    )
    add_camera(path, RigCamera("door", source="rtsp://admin:old@10.0.0.7/live"))
    assert [camera.name for camera in load_rig(path).cameras] == ["door", "white", "black"]
