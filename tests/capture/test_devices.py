"""Kinds of cameras: their sources, two names of one device, and cameras on USB of Windows and macOS."""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.capture import devices
from ipsys_log.capture.devices import check_sources, open_source
from ipsys_log.capture.frames import Clock, Frame, SourceError
from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera

Picture = NDArray[np.uint8]


class AttachedCamera:
    """A camera with the interface of ``cv2.VideoCapture``: it gives three images, and no gain can be set."""

    opened: ClassVar[list[AttachedCamera]] = []

    def __init__(self, number: int) -> None:
        self.number, self.released = number, False
        self.values = {
            cv2.CAP_PROP_FRAME_WIDTH: 64.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 48.0,
            cv2.CAP_PROP_FPS: 30.0,
        }
        self.pictures = [np.full((48, 64, 3), (20 * n, 100, 200), dtype=np.uint8) for n in range(3)]
        AttachedCamera.opened.append(self)

    def isOpened(self) -> bool:  # noqa: N802
        return self.number == 1

    def set(self, key: int, value: float) -> bool:
        if key not in (
            cv2.CAP_PROP_FOCUS,
            cv2.CAP_PROP_EXPOSURE,
            cv2.CAP_PROP_AUTO_EXPOSURE,
            cv2.CAP_PROP_AUTOFOCUS,
        ):
            return False
        self.values[key] = value
        return True

    def get(self, key: int) -> float:
        return self.values.get(key, 0.0)

    def read(self) -> tuple[bool, Picture | None]:
        return (True, self.pictures.pop(0)) if self.pictures else (False, None)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def attached(monkeypatch: pytest.MonkeyPatch) -> list[AttachedCamera]:
    """Make the system one without Video for Linux, with a camera as number 1."""
    monkeypatch.setattr(devices, "_SYSTEM", "darwin")
    monkeypatch.setattr(cv2, "VideoCapture", AttachedCamera)
    monkeypatch.setattr(AttachedCamera, "opened", [])
    return AttachedCamera.opened


def test_decoded_images_are_encoded_once_without_stamps(attached: list[AttachedCamera]) -> None:
    said: list[str] = []
    camera = RigCamera("red", source="usb:1", exposure_s=0.004, focus=20.0, gain=5.0, rate_hz=60.0)
    with open_source(camera, Clock(), said.append) as frames:
        came = list(islice(frames, 3))
        with pytest.raises(SourceError, match="red: usb:1: sends no frames; plug it in again"):
            next(frames)
    (device,) = attached
    assert device.released
    for number, frame in enumerate(came):
        assert isinstance(frame, Frame)
        assert (frame.format, frame.time_ns) == ("jpeg", None)
        decoded = simplejpeg.decode_jpeg(frame.data, colorspace="BGR")
        assert np.abs(decoded.astype(int) - (20 * number, 100, 200)).max() <= 3
    assert device.values[cv2.CAP_PROP_EXPOSURE] == pytest.approx(math.log2(0.004))
    assert device.values[cv2.CAP_PROP_AUTO_EXPOSURE] == device.values[cv2.CAP_PROP_AUTOFOCUS] == 0.0
    assert said[:2] == [
        "camera red: asked for 60 frames/s, but the camera gives 30",
        "camera red: asked for 5 of gain, but the camera cannot set this",
    ]
    assert "encodes them as JPEG again" in said[2]


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("usb:/dev/video0", "this system numbers its cameras; write usb:0 or usb:1"),
        ("usb:2", "camera number 2 does not exist, or another program uses it"),
    ],
)
def test_missing_camera_is_named(attached: list[AttachedCamera], source: str, text: str) -> None:
    with pytest.raises(SourceError, match=text), open_source(RigCamera("red", source=source), Clock(), print):
        pass
    assert all(device.released for device in attached)


def test_two_names_of_one_device_are_refused(tmp_path: Path) -> None:
    device, link = tmp_path / "video0", tmp_path / "by-id"
    device.touch()
    link.symlink_to(device)
    red, white = (RigCamera(name, source=f"usb:{path}") for name, path in (("red", device), ("white", link)))
    with pytest.raises(
        IpsysError, match=f"cameras red and white have the same device, {device}; give each its own"
    ):
        check_sources([red, white])
    other = tmp_path / "video1"
    other.touch()
    check_sources([red, RigCamera("black", source=f"usb:{other}")])


@pytest.mark.parametrize(
    ("source", "text"),
    [
        (None, 'has no source in the rig; write, for example, source = "usb:/dev/video0"'),
        ("/dev/video0", "source '/dev/video0': has no type; write \"usb:/dev/video0\""),
        ("ftp://10.0.0.2/", "source 'ftp://10.0.0.2/' has an unknown type; use one of http:, https:"),
        ("rtsp://user:***@10.0.0.2/", "its password is missing, because a log holds none; replace"),
        ("usb:/dev/no-such-camera", "device '/dev/no-such-camera' does not exist; 'ipsys cameras' lists"),
    ],
)
def test_wrong_source_says_what_to_write(source: str | None, text: str) -> None:
    with pytest.raises(IpsysError) as raised:
        check_sources([RigCamera("red", source=source)])
    assert str(raised.value).startswith("camera red: ")
    assert text in str(raised.value)
