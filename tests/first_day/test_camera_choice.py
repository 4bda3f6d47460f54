"""The cameras that a lab can use: their names and pictures, and typed addresses."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.app.first_day.camera_choice import (
    add_camera,
    list_options,
    parse_camera_address,
    propose_names,
    take_picture,
)
from ipsys_log.capture.frames import Clock, Frame, Say
from ipsys_log.capture.usb_bus import UsbCamera
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.plain_text import hide_password


def attached(device: Path, name: str, stable: str | None = None, fault: str | None = None) -> UsbCamera:
    device.touch()
    return UsbCamera(str(device), stable, name, None, (), fault)


def test_options_without_a_rig_are_attached_and_simulated_cameras(tmp_path: Path) -> None:
    first = attached(tmp_path / "video0", "Lab Camera", stable="/dev/v4l/by-id/lab")
    second = attached(tmp_path / "video2", "Web Camera", fault="Permission denied")
    options = list_options(None, [first, second])
    assert [(option.key, option.text, option.name) for option in options[:2]] == [
        ("usb:/dev/v4l/by-id/lab", "Lab Camera", ""),
        (f"usb:{tmp_path / 'video2'}", "Web Camera; Permission denied", ""),
    ]
    assert {option.text for option in options[2:]} == {"simulated lab, without hardware"}


def test_camera_of_the_rig_is_offered_once_also_under_another_path(tmp_path: Path) -> None:
    device = attached(tmp_path / "video0", "Lab Camera")
    (tmp_path / "by-id").symlink_to(tmp_path / "video0")
    rig = Rig(
        "lab",
        "DICT_4X4_100",
        0.2,
        cameras=(
            RigCamera("red", source=f"usb:{tmp_path / 'by-id'}"),
            RigCamera("white", source="rtsp://admin:secret@10.0.0.7/live"),
            RigCamera("black"),
        ),
    )
    options = [option for option in list_options(rig, [device]) if not option.key.startswith("sim:")]
    assert [(option.key, option.name) for option in options] == [
        (f"usb:{tmp_path / 'by-id'}", "red"),
        ("rtsp://admin:***@10.0.0.7/live", "white"),
    ]


def test_simulated_camera_in_use_is_not_offered_again() -> None:
    rig = Rig("lab", "DICT_4X4_100", 0.2, cameras=(RigCamera("red", source="sim:red"),))
    offered = [option.key for option in list_options(rig, [])]
    assert offered.count("sim:red") == 1
    assert "sim:white" in offered


def test_each_camera_has_a_proposed_name_of_its_own(tmp_path: Path) -> None:
    used = RigCamera("white", source="sim:black"), RigCamera("camera_1", source="rtsp://10.0.0.7/live")
    rig = Rig("lab", "DICT_4X4_100", 0.2, cameras=(*used, RigCamera("door")))
    devices = [attached(tmp_path / f"video{number}", "Lab Camera") for number in range(2)]
    options = list_options(rig, devices)
    assert dict(zip([option.key for option in options], propose_names(options, rig), strict=True)) == {
        "sim:black": "white",
        "rtsp://10.0.0.7/live": "camera_1",
        f"usb:{tmp_path / 'video0'}": "door",
        f"usb:{tmp_path / 'video1'}": "camera_2",
        "sim:red": "red",
        "sim:white": "camera_3",
    }


def test_picture_of_a_camera_is_its_first_image() -> None:
    """A node may send markers only, whose bytes may look like a keyframe; waits come between frames."""
    markers = Frame(bytes.fromhex("00000001 65 88"), "markers", None)
    frames = [None, markers, Frame(b"image", "jpeg", None)]

    @contextmanager
    def open_frames(_camera: RigCamera, _clock: Clock, _say: Say) -> Iterator[Iterator[Frame | None]]:
        yield iter(frames)

    def take() -> bytes | None:
        return take_picture(RigCamera("red"), open_frames, lambda text: None, lambda: False)

    assert take() == b"image"
    del frames[2]
    assert take() is None


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
