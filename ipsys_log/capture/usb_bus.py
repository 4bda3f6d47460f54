"""The USB bus: attached cameras, their connections and their modes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from ipsys_log.capture import v4l2

_INTERFACE, _ENDPOINT = 4, 5
_VIDEO_STREAMING = (14, 2)


class Mode(NamedTuple):
    """A mode of a camera; ``format`` is the driver's name of the pixel format, such as MJPG or YUYV."""

    format: str
    width: int
    height: int
    rate_hz: float


class UsbConnection(NamedTuple):
    """The USB connection of a camera.

    The fields are the bus, the port of the bus, the speed, the hub, and the most bytes that the camera can
    reserve in a microframe.
    """

    bus: int
    port: str
    speed_mbit_s: float
    hub: str
    most: int


class UsbCamera(NamedTuple):
    """An attached camera.

    ``stable`` is the device path that stays the same. ``fault`` is the reason if the modes
    cannot be read.
    """

    device: str
    stable: str | None
    name: str
    plug: UsbConnection | None
    modes: tuple[Mode, ...]
    fault: str | None = None


def find_cameras(root: Path = Path("/")) -> list[UsbCamera]:
    """Find all cameras of this machine.

    Parameters
    ----------
    root : folder that contains ``sys`` and ``dev``.
    """
    folder = root / "sys/class/video4linux"
    cameras = []
    for entry in sorted(folder.iterdir(), key=_number) if folder.is_dir() else ():
        device = root / "dev" / entry.name
        modes: list[Mode] = []
        fault = None
        try:
            fd = os.open(device, os.O_RDWR | os.O_NONBLOCK)
        except OSError as error:
            fault = error.strerror
        else:
            try:
                if not v4l2.is_camera(fd):
                    continue
                modes = list_modes(fd)
            except OSError as error:
                fault = error.strerror
            finally:
                os.close(fd)
        name = _read(entry / "name") or entry.name
        cameras.append(UsbCamera(str(device), _stable(root, device), name, _plug(entry), tuple(modes), fault))
    return cameras


def _number(entry: Path) -> int:
    return int("".join(filter(str.isdecimal, entry.name)) or 0)


def _stable(root: Path, device: Path) -> str | None:
    """Return the stable path of a device, by its serial number; by its port if two cameras share a number."""
    for kind in ("by-id", "by-path"):
        folder = root / "dev/v4l" / kind
        for link in sorted(folder.iterdir()) if folder.is_dir() else ():
            if link.resolve() == device.resolve():
                return str(link)
    return None


def _plug(entry: Path) -> UsbConnection | None:
    usb = next((part for part in entry.resolve().parents if (part / "busnum").is_file()), None)
    if usb is None:
        return None
    port = _read(usb / "devpath")
    return UsbConnection(int(_read(usb / "busnum")), port, float(_read(usb / "speed")), _hub(usb), _most(usb))


def _hub(usb: Path) -> str:
    hub = usb.parent
    name = " ".join(filter(None, (_read(hub / "manufacturer"), _read(hub / "product"))))
    # The root of the tree is the controller in the machine.
    if _read(hub / "devpath") in ("", "0"):
        return f"the machine's own, controller {hub.parent.name}"
    return f"{name or 'a hub'} at port {_read(hub / 'devpath')}"


def _most(usb: Path) -> int:
    """Return the most bytes per microframe of a video setting, from the descriptors (USB 2.0, 9.6)."""
    try:
        data = (usb / "descriptors").read_bytes()
    except OSError:
        data = b""
    streaming, most = False, 0
    offset = 0
    while offset + 1 < len(data) and data[offset]:
        length, kind = data[offset], data[offset + 1]
        if kind == _INTERFACE and length >= 9:
            streaming = (data[offset + 5], data[offset + 6]) == _VIDEO_STREAMING
        elif kind == _ENDPOINT and length >= 7 and streaming:
            size = int.from_bytes(data[offset + 4 : offset + 6], "little")
            most = max(most, (size & 0x7FF) * ((size >> 11 & 3) + 1))
        offset += length
    return most or 3 * 1024


def _read(path: Path) -> str:
    with suppress(OSError):
        return path.read_text(errors="replace").strip()
    return ""


def list_modes(device: int) -> list[Mode]:
    """List all modes of an open device; if sizes or rates come in steps, the smallest and the largest."""
    return [
        Mode(name, width, height, rate_hz)
        for name in v4l2.list_formats(device)
        for width, height in _sizes(device, v4l2.fourcc(name.ljust(4)))
        for rate_hz in _rates_hz(device, v4l2.fourcc(name.ljust(4)), width, height)
    ]


def _sizes(device: int, pixels: int) -> Iterator[tuple[int, int]]:
    def at(index: int) -> v4l2.FrameSize:
        return v4l2.FrameSize(index=index, pixel_format=pixels)

    for size in v4l2.enumerate_items(device, v4l2.ENUM_FRAMESIZES, at):
        sides = size.sides
        if size.type == v4l2.DISCRETE:
            yield sides[0], sides[1]
        else:
            yield from ((sides[0], sides[3]), (sides[1], sides[4]))
            return


def _rates_hz(device: int, pixels: int, width: int, height: int) -> Iterator[float]:
    def at(index: int) -> v4l2.FrameInterval:
        return v4l2.FrameInterval(index=index, pixel_format=pixels, width=width, height=height)

    for interval in v4l2.enumerate_items(device, v4l2.ENUM_FRAMEINTERVALS, at):
        times = interval.times
        yield times[1] / times[0]
        if interval.type != v4l2.DISCRETE:
            yield times[3] / times[2]
            return
