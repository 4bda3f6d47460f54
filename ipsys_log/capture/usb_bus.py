"""The cameras attached to this machine, and where on USB they hang, as sysfs has it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from ipsys_log.capture import v4l2

__all__ = ["Attached", "Mode", "Plug", "find_cameras", "list_modes"]

_INTERFACE, _ENDPOINT = 4, 5
_VIDEO_STREAMING = (14, 2)


class Mode(NamedTuple):
    """What a camera can be set to; ``format`` is the driver's name of it: MJPG, YUYV."""

    format: str
    width: int
    height: int
    rate_hz: float


class Plug(NamedTuple):
    """Where on USB a camera is plugged in: bus, port within it, the hub, and the most bytes it can reserve
    in a microframe."""

    bus: int
    port: str
    speed_mbit_s: float
    hub: str
    most: int


class Attached(NamedTuple):
    """A camera. ``stable`` is its path that stays the same; ``fault`` says why it could not be asked."""

    device: str
    stable: str | None
    name: str
    plug: Plug | None
    modes: tuple[Mode, ...]
    fault: str | None = None


def find_cameras(root: Path = Path("/")) -> list[Attached]:
    """All cameras of this machine.

    Parameters
    ----------
    root : below which ``sys`` and ``dev`` lie.
    """
    folder = root / "sys/class/video4linux"
    found = []
    for entry in sorted(folder.iterdir(), key=_number) if folder.is_dir() else ():
        device = root / "dev" / entry.name
        modes: list[Mode] = []
        fault = None
        try:
            opened = os.open(device, os.O_RDWR | os.O_NONBLOCK)
        except OSError as error:
            fault = error.strerror
        else:
            try:
                if not v4l2.is_camera(opened):
                    continue
                modes = list_modes(opened)
            except OSError as error:
                fault = error.strerror
            finally:
                os.close(opened)
        name = _read(entry / "name") or entry.name
        found.append(Attached(str(device), _stable(root, device), name, _plug(entry), tuple(modes), fault))
    return found


def _number(entry: Path) -> int:
    return int("".join(filter(str.isdecimal, entry.name)) or 0)


def _stable(root: Path, device: Path) -> str | None:
    """By the camera's serial number or, where two have the same, by the port it is plugged into."""
    for kind in ("by-id", "by-path"):
        folder = root / "dev/v4l" / kind
        for link in sorted(folder.iterdir()) if folder.is_dir() else ():
            if link.resolve() == device.resolve():
                return str(link)
    return None


def _plug(entry: Path) -> Plug | None:
    usb = next((part for part in entry.resolve().parents if (part / "busnum").is_file()), None)
    if usb is None:
        return None
    port = _read(usb / "devpath")
    return Plug(int(_read(usb / "busnum")), port, float(_read(usb / "speed")), _hub(usb), _most(usb))


def _hub(usb: Path) -> str:
    hub = usb.parent
    name = " ".join(filter(None, (_read(hub / "manufacturer"), _read(hub / "product"))))
    # The root of the tree is the controller in the machine.
    if _read(hub / "devpath") in ("", "0"):
        return f"the machine's own, controller {hub.parent.name}"
    return f"{name or 'a hub'} at port {_read(hub / 'devpath')}"


def _most(usb: Path) -> int:
    """Bytes in a microframe of the widest setting for pictures, from the descriptors (USB 2.0, 9.6)."""
    try:
        data = (usb / "descriptors").read_bytes()
    except OSError:
        data = b""
    streaming, most = False, 0
    at = 0
    while at + 1 < len(data) and data[at]:
        length, kind = data[at], data[at + 1]
        if kind == _INTERFACE and length >= 9:
            streaming = (data[at + 5], data[at + 6]) == _VIDEO_STREAMING
        elif kind == _ENDPOINT and length >= 7 and streaming:
            size = int.from_bytes(data[at + 4 : at + 6], "little")
            most = max(most, (size & 0x7FF) * ((size >> 11 & 3) + 1))
        at += length
    return most or 3 * 1024


def _read(path: Path) -> str:
    with suppress(OSError):
        return path.read_text(errors="replace").strip()
    return ""


def list_modes(device: int) -> list[Mode]:
    """All that an open device can be set to; of sizes and rates in steps, the least and the greatest."""
    return [
        Mode(name, width, height, rate_hz)
        for name in v4l2.list_formats(device)
        for width, height in _sizes(device, v4l2.fourcc(name.ljust(4)))
        for rate_hz in _rates_hz(device, v4l2.fourcc(name.ljust(4)), width, height)
    ]


def _sizes(device: int, pixels: int) -> Iterator[tuple[int, int]]:
    def at(index: int) -> v4l2.FrameSize:
        return v4l2.FrameSize(index=index, pixel_format=pixels)

    for size in v4l2.each(device, v4l2.ENUM_FRAMESIZES, at):
        sides = size.sides
        if size.type == v4l2.DISCRETE:
            yield sides[0], sides[1]
        else:
            yield from ((sides[0], sides[3]), (sides[1], sides[4]))
            return


def _rates_hz(device: int, pixels: int, width: int, height: int) -> Iterator[float]:
    def at(index: int) -> v4l2.FrameInterval:
        return v4l2.FrameInterval(index=index, pixel_format=pixels, width=width, height=height)

    for interval in v4l2.each(device, v4l2.ENUM_FRAMEINTERVALS, at):
        times = interval.times
        yield times[1] / times[0]
        if interval.type != v4l2.DISCRETE:
            yield times[3] / times[2]
            return
