"""The USB bus: attached cameras, their connections and modes, and the bandwidth that they need."""

import math
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from ipsys_log.capture import v4l2
from ipsys_log.capture.frames import device_path
from ipsys_log.messages import Rig, RigCamera

_INTERFACE, _ENDPOINT = 4, 5
_VIDEO_STREAMING = (14, 2)
# USB 2 gives at most 80 % of a microframe of 125 us to transfers at fixed times (USB 2.0, 5.6.4). At
# 480 Mbit/s a microframe has 7500 bytes, so these transfers get 6000 bytes.
_MICROFRAMES_PER_S = 8000
_CARRIES = 6000
_USB_2_MBIT_S = 480
# Extra bytes of a packet on the wire (USB 2.0, 5.6.3), and its largest payload in bytes.
_HEAD = 38
_PACKET = 1024
# At the usual quality of cameras, JPEG of a scene with many details takes up to 2 bits per pixel.
# The table gives the bytes per pixel of other formats.
_JPEG_BYTES_PER_PX = 0.25
_BYTES_PER_PX = {"YUYV": 2.0, "UYVY": 2.0, "NV12": 1.5, "GREY": 1.0}
_RATES_HZ = (60, 30, 25, 20, 15, 10, 5)
_SIZES_PX = (
    (1920, 1080),
    (1600, 1200),
    (1280, 960),
    (1280, 720),
    (1024, 768),
    (800, 600),
    (640, 480),
    (640, 360),
)


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
    """Find all cameras of this machine. ``root`` contains ``sys`` and ``dev``."""
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


class BandwidthDemand(NamedTuple):
    """The bandwidth demand of a camera.

    ``bus`` is the number of its USB bus. ``hub`` describes the hub that it is plugged into. ``most`` is the
    largest number of bytes that it can reserve in each microframe, from its descriptors.
    """

    camera: str
    bus: int
    speed_mbit_s: float
    hub: str
    format: str
    width: int
    height: int
    rate_hz: float
    most: int = 3 * _PACKET


def list_demands(attached: Sequence[UsbCamera], rig: Rig | None) -> list[BandwidthDemand]:
    """Return the demands of the cameras on USB: the settings of the rig, or else the largest JPEG modes.

    Parameters
    ----------
    attached : cameras from :func:`find_cameras`.
    rig : rig of the cameras that run; None if all attached cameras run.
    """
    requests: list[tuple[UsbCamera, str, RigCamera | None]]
    if rig is None:
        requests = [(camera, camera.device, None) for camera in attached]
    else:
        by_path = {Path(camera.device).resolve(): camera for camera in attached}
        usb_cameras = [camera for camera in rig.cameras if (camera.source or "").startswith("usb:")]
        paths = ((camera, Path(device_path(camera.source or "")).resolve()) for camera in usb_cameras)
        requests = [(by_path[path], camera.name, camera) for camera, path in paths if path in by_path]
    demands = []
    for camera, name, rig_camera in requests:
        modes = [mode for mode in camera.modes if mode.format in ("MJPG", "JPEG")] or camera.modes
        if camera.plug is None or not modes:
            continue
        mode = max(modes, key=lambda mode: (mode.width * mode.height, mode.rate_hz))
        width, height = (rig_camera.width, rig_camera.height) if rig_camera else (None, None)
        rate_hz = (rig_camera.rate_hz if rig_camera else None) or mode.rate_hz
        bus, _, speed_mbit_s, hub, most = camera.plug
        size = (width or mode.width, height or mode.height)
        demands.append(BandwidthDemand(name, bus, speed_mbit_s, hub, mode.format, *size, rate_hz, most))
    return demands


def advise_bandwidth(demands: Sequence[BandwidthDemand]) -> list[str]:
    """Return one line per overloaded bus: its cameras, its hub, the bandwidth, and modes that would fit.

    Many cameras reserve as much as they can, at any rate and size. A line also warns that such cameras may
    not start.

    Parameters
    ----------
    demands : demands of all cameras that run at the same time.

    Examples
    --------
    >>> three = [BandwidthDemand(name, 1, 480, "a hub", "MJPG", 1920, 1080, 30.0) for name in ("a", "b", "c")]
    >>> print(advise_bandwidth(three)[0])
    cameras a, b and c share USB bus 1 (a hub) and need 48.5 MB/s of its 48: plug one camera into another bus, or set 25 frames/s for each, or set 1600 x 1200 px
    """  # noqa: E501
    by_bus = defaultdict(list)
    for demand in demands:
        if demand.speed_mbit_s <= _USB_2_MBIT_S:
            by_bus[demand.bus].append(demand)
    lines = (_explain(bus, shared) for bus, shared in sorted(by_bus.items()))
    return [line for line in lines if line]


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


def _explain(bus: int, shared: Sequence[BandwidthDemand]) -> str | None:
    *names, last = sorted(demand.camera for demand in shared)
    hubs = ", ".join(sorted({demand.hub for demand in shared}))
    subject = f"cameras {', '.join(names)} and {last} share" if names else f"camera {last} is alone on"
    needed, most = (_wire_bytes(shared, each) for each in (_needed, lambda demand: demand.most))
    carries = f"MB/s of its {_CARRIES * _MICROFRAMES_PER_S / 1e6:.0f}"
    if needed > _CARRIES:
        ways = ["plug one camera into another bus"] if names else []
        ways += _smaller(shared)
        demand_text = f"need {_mb_s(needed)}" if names else f"needs {_mb_s(needed)}"
        return f"{subject} USB bus {bus} ({hubs}) and {demand_text} {carries}: {', or '.join(ways)}"
    if names and most > _CARRIES:
        return (
            f"{subject} USB bus {bus} ({hubs}) and may reserve {_mb_s(most)} {carries}: "
            "if one of them does not start, plug it into another bus"
        )
    return None


def _mb_s(per_microframe: int) -> str:
    return f"{per_microframe * _MICROFRAMES_PER_S / 1e6:.1f}"


def _smaller(shared: Sequence[BandwidthDemand]) -> list[str]:
    """Return the ways to fit all cameras: the highest rate, the largest size, and a smaller format."""
    ways = []
    for rate_hz in _RATES_HZ:
        slower = [demand._replace(rate_hz=min(rate_hz, demand.rate_hz)) for demand in shared]
        if _wire_bytes(slower, _needed) <= _CARRIES:
            ways.append(f"set {rate_hz} frames/s" + (" for each" if len(shared) > 1 else ""))
            break
    largest = max(demand.width * demand.height for demand in shared)
    for width, height in _SIZES_PX:
        less = [demand._replace(width=width, height=height) for demand in shared]
        if width * height < largest and _wire_bytes(less, _needed) <= _CARRIES:
            ways.append(f"set {width} x {height} px")
            break
    if any(demand.format in _BYTES_PER_PX for demand in shared):
        ways.append("use a camera with MJPG")
    return ways


def _needed(demand: BandwidthDemand) -> int:
    per_px = _BYTES_PER_PX.get(demand.format, _JPEG_BYTES_PER_PX)
    return math.ceil(demand.width * demand.height * demand.rate_hz * per_px / _MICROFRAMES_PER_S)


def _wire_bytes(shared: Sequence[BandwidthDemand], own: Callable[[BandwidthDemand], int]) -> int:
    """Return the bytes that cameras take of a microframe on the wire, with the heads of the packets."""
    return sum(own(demand) + _HEAD * math.ceil(own(demand) / _PACKET) for demand in shared)
