"""The attached cameras and the load of their USB bus, read from a simulated sysfs."""

import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.capture import usb_bus, v4l2
from ipsys_log.capture.usb_bus import (
    BandwidthDemand,
    Mode,
    UsbConnection,
    advise_bandwidth,
    find_cameras,
    list_demands,
)
from ipsys_log.messages import Rig, RigCamera
from tests.capture.camera_driver import Driver
from tests.conftest import Ipsys

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Video for Linux")

CONTROLLER = "sys/devices/pci0000:00/0000:00:14.0/usb1"


def interface(number: int, setting: int, kind: int) -> bytes:
    return struct.pack("<BBBBBBBBB", 9, 4, number, setting, 1, 14, kind, 0, 0)


def endpoint(size: int, more: int = 0) -> bytes:
    return struct.pack("<BBBBHB", 7, 5, 0x81, 5, size | more << 11, 1)


# The control interface has an endpoint that sends no images.
DESCRIPTORS = (
    bytes([18, 1, *[0] * 16])
    + interface(0, 0, 1) + endpoint(1024, 2)
    + interface(1, 1, 2) + endpoint(512)
    + interface(1, 2, 2) + endpoint(1020, 2)
)  # fmt: skip


@pytest.fixture
def plug_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int, str], None]:
    """Plug a camera into a port of a machine whose port 2 has a hub."""
    files = {
        "": {"busnum": "1", "devpath": "0", "product": "xHCI Host Controller", "speed": "480"},
        "1-2": {"busnum": "1", "devpath": "2", "product": "USB2.0 Hub", "manufacturer": "Acme"},
    }
    for name, values in files.items():
        write(tmp_path / CONTROLLER / name, values)
    monkeypatch.setattr(v4l2, "ioctl", answer)

    def plug(number: int, port: str) -> None:
        usb = tmp_path / CONTROLLER / ("1-2/" if port.startswith("2.") else "") / f"1-{port}"
        write(usb, {"busnum": "1", "devpath": port, "speed": "480", "product": "Camera"})
        (usb / "descriptors").write_bytes(DESCRIPTORS)
        entry = usb / f"1-{port}:1.0/video4linux/video{number}"
        write(entry, {"name": f"Lab Camera {number}"})
        links = tmp_path / "sys/class/video4linux", tmp_path / "dev/v4l/by-id"
        for folder in links:
            folder.mkdir(parents=True, exist_ok=True)
        (links[0] / entry.name).symlink_to(entry)
        device = tmp_path / "dev" / entry.name
        Driver(device)
        (links[1] / f"usb-Acme_{number}-video-index0").symlink_to(device)

    return plug


def answer(device: int, request: int, about: object, change: bool) -> int:
    """Return devices that are cameras with the same modes."""
    path = Path(f"/proc/self/fd/{device}").resolve()
    if path.name == "video9":
        raise OSError(25, "Inappropriate ioctl for device")
    kept = path.read_bytes()
    driver = Driver(path)
    path.write_bytes(kept)
    return driver(device, request, about, change)


def write(folder: Path, values: dict[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in values.items():
        (folder / name).write_text(value + "\n")


def test_camera_poses_are_recovered(tmp_path: Path, plug_in: Callable[[int, str], None]) -> None:
    for number, port in ((10, "2.3"), (2, "4"), (9, "5")):  # 9 is a device without images
        plug_in(number, port)
    first, second = find_cameras(tmp_path)
    assert (first.device, first.name) == (str(tmp_path / "dev/video2"), "Lab Camera 2")
    assert first.stable == str(tmp_path / "dev/v4l/by-id/usb-Acme_2-video-index0")
    assert first.plug == UsbConnection(1, "4", 480.0, "the machine's own, controller 0000:00:14.0", 3060)
    assert second.plug == UsbConnection(1, "2.3", 480.0, "Acme USB2.0 Hub at port 2", 3060)
    assert first.modes == (
        Mode("YUYV", 640, 480, 30),
        Mode("MJPG", 1920, 1080, 30),
        Mode("MJPG", 1920, 1080, 15),
        Mode("MJPG", 1280, 720, 60),
        Mode("MJPG", 1280, 720, 30),
    )


def test_a_camera_that_may_not_be_opened_is_listed(
    tmp_path: Path, plug_in: Callable[[int, str], None]
) -> None:
    plug_in(0, "4")
    (tmp_path / "dev/video0").unlink()
    (camera,) = find_cameras(tmp_path)
    assert camera.fault == "No such file or directory"
    assert camera.modes == ()


def test_bus_load_uses_the_settings_of_the_rig(tmp_path: Path, plug_in: Callable[[int, str], None]) -> None:
    for number in (0, 1, 2):
        plug_in(number, f"2.{number + 1}")
    found = find_cameras(tmp_path)
    assert [(d.camera, d.width, d.rate_hz) for d in list_demands(found, None)] == [
        (str(tmp_path / f"dev/video{n}"), 1920, 30.0) for n in (0, 1, 2)
    ]
    rig = Rig(
        "lab", "DICT_4X4_100", 0.2,
        cameras=(
            RigCamera("red", source=f"usb:{found[2].stable}", width=640, height=480, rate_hz=15.0),
            RigCamera("white", source=f"usb:{tmp_path}/dev/video0"),
            RigCamera("black", source="rtsp://10.0.0.7/live"),
        ),
    )  # fmt: skip
    red, white = list_demands(found, rig)
    assert red == BandwidthDemand("red", 1, 480.0, "Acme USB2.0 Hub at port 2", "MJPG", 640, 480, 15.0, 3060)
    assert white[4:8] == ("MJPG", 1920, 1080, 30.0)


def cameras(count: int, **other: Any) -> list[BandwidthDemand]:
    demand = BandwidthDemand("red", 1, 480.0, "Acme Hub at port 2", "MJPG", 1920, 1080, 30.0, 1024)
    names = ("red", "white", "black", "blue")
    return [demand._replace(camera=name, **other) for name in names[:count]]


def test_cameras_that_fit_a_bus_get_no_advice() -> None:
    """USB 2.0, section 5.6.4, allows 80 % of 480 Mbit/s: 48 MB/s.

    Two of 1920 x 1080 x 30 x 0.25 B are 31 MB/s.
    """
    assert advise_bandwidth(cameras(2)) == []
    assert advise_bandwidth(cameras(3, rate_hz=25.0)) == []
    assert advise_bandwidth(cameras(3, width=1280, height=720)) == []
    # Four cameras fit on separate buses, or on USB 3.
    assert advise_bandwidth([demand._replace(bus=n) for n, demand in enumerate(cameras(4))]) == []
    assert advise_bandwidth(cameras(4, speed_mbit_s=5000.0)) == []


def test_overloaded_bus_is_explained() -> None:
    (line,) = advise_bandwidth([*cameras(4), *cameras(1, bus=2)])
    assert line == (
        "cameras black, blue, red and white share USB bus 1 (Acme Hub at port 2) and need "
        "64.6 MB/s of its 48: plug one camera into another bus, or set 20 frames/s for each, or set "
        "1280 x 960 px"
    )
    # The advised settings fit.
    assert advise_bandwidth(cameras(4, rate_hz=20.0)) == []
    assert advise_bandwidth(cameras(4, width=1280, height=960)) == []
    assert advise_bandwidth(cameras(4, rate_hz=25.0)) != []


def test_single_camera_can_overload_a_bus() -> None:
    (line,) = advise_bandwidth(cameras(1, format="YUYV"))
    assert line == (
        "camera red is alone on USB bus 1 (Acme Hub at port 2) and needs 129.3 MB/s of its 48: "
        "set 10 frames/s, or set 800 x 600 px, or use a camera with MJPG"
    )


def test_cameras_that_reserve_all_they_can_may_not_start() -> None:
    (line,) = advise_bandwidth(cameras(2, most=3072, rate_hz=10.0))
    assert "may reserve 51.0 MB/s of its 48: if one of them does not start" in line


def test_cameras_command_lists_the_bus_load(
    tmp_path: Path, plug_in: Callable[[int, str], None], ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(usb_bus, "find_cameras", lambda: find_cameras(tmp_path))
    done = ipsys("cameras")
    assert (done.code, done.out.splitlines()[0]) == (0, "no USB camera is attached")
    assert "rtsp://" in done.out
    assert "sim:red" in done.out
    for number in (0, 1, 2, 3):
        plug_in(number, f"2.{number + 1}")
    done = ipsys("cameras")
    assert f'Lab Camera 0: source = "usb:{tmp_path}/dev/v4l/by-id/usb-Acme_0-video-index0"' in done.out
    assert "  USB bus 1, port 2.1, 480 Mbit/s; hub: Acme USB2.0 Hub at port 2\n" in done.out
    assert "  MJPG  1920 x 1080 30, 15 frames/s\n" in done.out
    assert "share USB bus 1" in done.out.splitlines()[-1]
    plain = json.loads(ipsys("cameras", "--json").out)
    assert len(plain["cameras"]) == 4
    assert plain["cameras"][3]["plug"]["port"] == "2.4"
    assert len(plain["advice"]) == 1


def test_cameras_that_fit_in_no_mode_need_another_bus() -> None:
    """Thirty cameras do not fit at the lowest rate, and not at the smallest size."""
    many = [demand._replace(camera=f"c{n:02}") for n, demand in enumerate(cameras(1) * 30)]
    (line,) = advise_bandwidth(many)
    assert line.endswith(": plug one camera into another bus")


def test_camera_outside_of_usb_has_no_demand(tmp_path: Path, plug_in: Callable[[int, str], None]) -> None:
    plug_in(0, "4")
    (found,) = find_cameras(tmp_path)
    assert list_demands([found._replace(plug=None)], None) == []
    assert list_demands([found._replace(modes=())], None) == []
