"""Cameras on USB: no camera is needed, :mod:`tests.capture.camera_driver` answers for the kernel."""

import errno
import sys
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.capture import devices, v4l2, v4l2_camera
from ipsys_log.capture.devices import open_usb
from ipsys_log.capture.frames import Clock, Frame, SourceError
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S
from tests.capture.camera_driver import Driver

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Video for Linux")


@pytest.fixture
def driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Driver:
    driver = Driver(tmp_path / "video0")
    monkeypatch.setattr(v4l2, "ioctl", driver)
    return driver


def ask(driver: Driver, **asked: float | str | None) -> RigCamera:
    return RigCamera("red", source=f"usb:{driver.path}", **asked)  # type: ignore[arg-type]


def test_requests_are_those_of_the_kernel() -> None:
    """The numbers are the output of a C program with linux/videodev2.h on 64 bits."""
    numbers = {
        "QUERYCAP": 0x80685600, "ENUM_FMT": 0xC0405602, "S_FMT": 0xC0D05605, "REQBUFS": 0xC0145608,
        "QUERYBUF": 0xC0585609, "QBUF": 0xC058560F, "DQBUF": 0xC0585611, "STREAMON": 0x40045612,
        "STREAMOFF": 0x40045613, "G_PARM": 0xC0CC5615, "S_PARM": 0xC0CC5616, "G_CTRL": 0xC008561B,
        "S_CTRL": 0xC008561C, "ENUM_FRAMESIZES": 0xC02C564A, "ENUM_FRAMEINTERVALS": 0xC034564B,
    }  # fmt: skip
    assert {name: getattr(v4l2, name) for name in numbers} == numbers
    buffer = v4l2.Buffer
    assert (buffer.seconds.offset, buffer.offset.offset, buffer.length.offset) == (24, 64, 72)
    assert v4l2.Format.width.offset == 8


def test_frames_are_the_cameras_bytes_with_the_drivers_stamps(driver: Driver) -> None:
    # There are more frames than buffers, so each buffer is returned; an empty frame is dropped.
    pictures = [bytes([n]) * (1000 + n) for n in range(20)]
    driver.frames.extend([*pictures[:3], b"", *pictures[3:]])
    clock = Clock()
    said: list[str] = []
    with open_usb(ask(driver, width=1920, height=1080, rate_hz=30.0), clock, said.append) as frames:
        came = list(islice((frame for frame in frames if frame), 20))
    del driver.stamps_ns[3]
    expected = [clock.to_utc_ns(stamp // 1000 * 1000) for stamp in driver.stamps_ns]
    assert [frame[:3] for frame in came] == [
        (data, "jpeg", time) for data, time in zip(pictures, expected, strict=True)
    ]
    assert [n for n, frame in enumerate(came) if frame.missed] == [
        3
    ]  # the one with the empty frame before it
    assert not driver.streaming
    assert said == ['camera red: the driver stamps the start of a frame; write into the rig: stamp = "start"']


@pytest.mark.parametrize(
    ("numbers", "missed"),
    [
        ((0, 1, 2, 3), (0, 0, 0, 0)),
        ((7, 8, 11, 12), (0, 0, 2, 0)),
        ((2**32 - 2, 2**32 - 1, 1, 2), (0, 0, 1, 0)),
        ((0, 0, 0, 0), (0, 0, 0, 0)),  # without a sequence number
        ((500, 501, 0, 1), (0, 0, 0, 0)),  # the count restarts
    ],
)
def test_frames_that_the_driver_lost_are_told(
    driver: Driver, numbers: tuple[int, ...], missed: tuple[int, ...]
) -> None:
    driver.frames.extend([b"x"] * 4)
    driver.numbers = iter(numbers)
    with open_usb(ask(driver), Clock(), lambda _: None) as frames:
        assert tuple(frame.missed for frame in islice((one for one in frames if one), 4)) == missed


def test_silent_stream_is_reported_and_then_closed(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> None:
    class Later(Clock):
        ahead_ns = 0

        def now_ns(self) -> int:
            return super().now_ns() + self.ahead_ns

    monkeypatch.setattr(v4l2_camera, "_SILENT_S", 3600.0)
    clock = Later()
    with open_usb(ask(driver), clock, lambda _: None) as frames:
        assert [next(frames), next(frames)] == [None, None]
        clock.ahead_ns = 3601 * NS_PER_S
        with pytest.raises(SourceError, match=r"camera red: .*video0: sends no frames; plug it in again"):
            list(frames)


@pytest.mark.parametrize(("mode", "bad"), [("MJPG", b""), ("YUYV", b""), ("YUYV", b"half a picture")])
def test_camera_without_valid_data_is_lost(
    driver: Driver, monkeypatch: pytest.MonkeyPatch, mode: str, bad: bytes
) -> None:
    monkeypatch.setattr(v4l2_camera, "_SILENT_S", 0.2)
    driver.modes = {mode: [(64, 48, [30])]}
    driver.frames.extend([bad] * 300_000)
    with (
        open_usb(ask(driver, width=64, height=48), Clock(), lambda _: None) as frames,
        pytest.raises(SourceError, match="sends no frames"),
    ):
        list(frames)
    assert driver.frames, "the camera was lost only after its last frame"


def test_opencv_camera_can_be_unplugged_and_return() -> None:
    frames = devices._frames(cv2.VideoCapture(), "camera red: usb:0")
    with pytest.raises(SourceError, match="camera red: usb:0: sends no frames"):
        next(frames)


def test_settings_that_a_camera_refuses_are_reported(driver: Driver) -> None:
    said: list[str] = []
    asked = ask(
        driver, width=1900, height=1000, rate_hz=60.0, exposure_s=1.0, focus=12.0, gain=50.0, stamp="end"
    )
    driver.frames.append(b"x")
    with open_usb(asked, Clock(), said.append) as frames:
        next(frames)
    assert said == [
        "camera red: asked for 1900 x 1000 px, but the camera gives 1920 x 1080",
        "camera red: asked for 60 frames/s, but the camera gives 30",
        "camera red: asked for 1 s of exposure, but the camera gives 0.5",
        "camera red: asked for 12 of focus, but the camera cannot set this",
        "camera red: the driver stamps the start of a frame, but the rig has 'end'",
    ]
    assert driver.controls[0x9A0901][2] == 1  # manual exposure


def test_accepted_settings_give_no_message(driver: Driver) -> None:
    said: list[str] = []
    driver.flags = v4l2.STAMP_MONOTONIC
    driver.frames.append(b"x")
    asked = ask(driver, width=1280, height=720, rate_hz=60.0, exposure_s=0.005, gain=10.0, stamp="end")
    with open_usb(asked, Clock(), said.append) as frames:
        next(frames)
    assert said == []
    assert driver.size == (1280, 720)
    assert driver.rate == (1, 60)
    assert driver.controls[0x9A0902][2] == 50
    assert driver.controls[0x980913][2] == 10


def test_stamp_of_another_clock_is_ignored(driver: Driver) -> None:
    said: list[str] = []
    driver.flags = 0
    driver.frames.append(b"x")
    with open_usb(ask(driver), Clock(), said.append) as frames:
        assert next(frames) == Frame(b"x", "jpeg", None)
    assert "with another clock" in said[0]


def test_a_camera_that_is_pulled_out(driver: Driver) -> None:
    driver.frames.extend([b"x", OSError(errno.ENODEV, "No such device")])
    with open_usb(ask(driver), Clock(), lambda _: None) as frames:
        assert next(frames)
        with pytest.raises(SourceError, match=r"camera red: .*video0: is disconnected; check its cable"):
            next(frames)


def test_a_bus_that_is_full(driver: Driver) -> None:
    driver.no_room = True
    with (
        pytest.raises(SourceError, match="its USB bus has too little bandwidth"),
        open_usb(ask(driver), Clock(), lambda _: None),
    ):
        pass


def test_a_camera_of_no_known_format(driver: Driver) -> None:
    driver.modes = {"H264": [(1920, 1080, [30])], "BA81": [(1920, 1080, [30])]}
    with (
        pytest.raises(SourceError, match="has only H264, BA81; use a camera with MJPG"),
        open_usb(ask(driver), Clock(), lambda _: None),
    ):
        pass


def raw(name: str, picture: NDArray[np.uint8], stride: int) -> bytes:
    """Return an image in the layout of FFmpeg's converter, with padded rows."""
    frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
    kind = {"YUYV": "yuyv422", "UYVY": "uyvy422", "NV12": "nv12", "GREY": "gray"}[name]
    planes = frame.reformat(format=kind, dst_color_range="JPEG").planes
    padded = b""
    for plane in planes:
        rows = np.frombuffer(bytes(plane), np.uint8).reshape(plane.height, plane.line_size)
        rows = rows[:, : min(stride, plane.line_size)]
        padded += np.pad(rows, ((0, 0), (0, stride - rows.shape[1])), constant_values=99).tobytes()
    return padded


@pytest.mark.parametrize(("name", "stride"), [("YUYV", 640), ("YUYV", 704), ("UYVY", 640), ("NV12", 320),
                                              ("NV12", 384), ("GREY", 320), ("GREY", 352)])  # fmt: skip
def test_pictures_of_a_camera_without_jpeg_are_encoded_once(driver: Driver, name: str, stride: int) -> None:
    driver.modes, driver.stride, driver.size = {name: [(320, 240, [30])]}, stride, (320, 240)
    y, x = np.indices((240, 320))
    picture = np.stack([x * 255 // 319, y * 255 // 239, 128 + 100 * np.sin(x / 20)], axis=2).astype(np.uint8)
    whole = raw(name, picture, stride)
    driver.frames.extend([whole, whole[:-1000], whole])
    said: list[str] = []
    with open_usb(ask(driver, stamp="start"), Clock(), said.append) as frames:
        came = list(islice((frame for frame in frames if frame), 2))
    assert [frame.format for frame in came] == ["jpeg", "jpeg"]
    assert came[0].time_ns is not None
    shown = simplejpeg.decode_jpeg(came[0].data, colorspace="BGR").astype(float)
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(float)
    assert shown.shape == (240, 320, 3)
    assert np.abs(shown @ [0.114, 0.587, 0.299] - grey).max() < 8
    assert np.abs(shown - (grey[..., None] if name == "GREY" else picture)).mean() < 3
    assert said == [
        f"camera red: gives no MJPG; ipsys encodes its {name} images as JPEG",
        "camera red: sends incomplete images; they are not recorded",
    ]


@pytest.mark.parametrize(
    ("source", "said"), [("usb:/nowhere/video9", "does not exist"), ("usb:/dev/null", "is not a camera")]
)
def test_device_that_is_no_camera_is_refused(source: str, said: str) -> None:
    """Test with the real kernel."""
    with (
        pytest.raises(SourceError, match=said),
        open_usb(RigCamera("red", source=source), Clock(), lambda _: None),
    ):
        pass
