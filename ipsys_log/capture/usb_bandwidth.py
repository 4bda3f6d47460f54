"""The bandwidth that the cameras of a USB bus need, and advice for an overloaded bus."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from ipsys_log.capture.frames import device_path
from ipsys_log.capture.usb_bus import UsbCamera
from ipsys_log.messages import Rig, RigCamera

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
_SIZES = (
    (1920, 1080),
    (1600, 1200),
    (1280, 960),
    (1280, 720),
    (1024, 768),
    (800, 600),
    (640, 480),
    (640, 360),
)


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
    attached : cameras from :func:`~ipsys_log.capture.usb_bus.find_cameras`.
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


def advise(demands: Sequence[BandwidthDemand]) -> list[str]:
    """Return one line per overloaded bus: its cameras, its hub, the bandwidth, and modes that would fit.

    Many cameras reserve as much as they can, at any rate and size. A line also warns that such cameras may
    not start.

    Parameters
    ----------
    demands : demands of all cameras that run at the same time.

    Examples
    --------
    >>> three = [BandwidthDemand(name, 1, 480, "a hub", "MJPG", 1920, 1080, 30.0) for name in ("a", "b", "c")]
    >>> print(advise(three)[0])
    cameras a, b and c share USB bus 1 (a hub) and need 48.5 MB/s of its 48: plug one camera into another bus, or set 25 frames/s for each, or set 1600 x 1200 px
    """  # noqa: E501
    by_bus = defaultdict(list)
    for demand in demands:
        if demand.speed_mbit_s <= _USB_2_MBIT_S:
            by_bus[demand.bus].append(demand)
    lines = (_explain(bus, shared) for bus, shared in sorted(by_bus.items()))
    return [line for line in lines if line]


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
    for width, height in _SIZES:
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
