"""The cameras that the setup offers: those of the rig first, and no device twice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ipsys_log.app.first_day.camera_choice import list_options, propose_names, take_picture
from ipsys_log.capture.frames import Clock, Frame, Say
from ipsys_log.capture.usb_bus import UsbCamera
from ipsys_log.messages import Rig, RigCamera


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
