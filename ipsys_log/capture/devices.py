"""Which opener a camera's ``source`` in the rig is for."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from ipsys_log.capture.asked import device_of
from ipsys_log.capture.bandwidth import advise, demands_of
from ipsys_log.capture.frames import Clock, Frame, Open, Say
from ipsys_log.capture.network import check_address, open_network
from ipsys_log.capture.played import check_played, open_played
from ipsys_log.capture.simulated import open_simulated, parse_source
from ipsys_log.capture.usb import open_usb
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.rig.file import HIDDEN, hide_password

__all__ = ["OPENERS", "check_devices", "check_sources", "open_source", "usb_advice"]

# By what stands before the first colon of a source.
OPENERS: dict[str, Open] = {
    "http": open_network,
    "https": open_network,
    "rtsp": open_network,
    "rtsps": open_network,
    "tcp": open_network,
    "udp": open_network,
    "usb": open_usb,
    "sim": open_simulated,
    "file": open_played,
}


def check_devices(cameras: Iterable[RigCamera]) -> None:
    """See that no two cameras are one device, by whatever names.

    Raises
    ------
    IpsysError
        Naming both.
    """
    known: dict[Path, str] = {}
    for camera in cameras:
        if camera.source and camera.source.startswith("usb:"):
            device = Path(device_of(camera.source)).resolve()
            other = known.setdefault(device, camera.name)
            if other != camera.name:
                raise IpsysError(
                    f"cameras {other} and {camera.name} are one device, {device}; give each its own"
                )


def check_sources(cameras: Iterable[RigCamera]) -> None:
    """Check that each camera has a source that can be opened, as far as its text shows.

    Raises
    ------
    IpsysError
        A source is invalid, or its file or device does not exist.
    """
    for camera in cameras:
        source = str(camera.source)
        if _opener(camera) is open_network:
            check_address(camera)
        elif _opener(camera) is open_simulated:
            parse_source(camera)
        elif _opener(camera) is open_played:
            check_played(camera)
        elif sys.platform == "linux" and not Path(device_of(source)).exists():
            raise IpsysError(
                f"camera {camera.name}: there is no device {device_of(source)!r}; 'ipsys cameras' "
                "lists what is attached"
            )


def usb_advice(rig: Rig) -> list[str]:
    """What to change where USB does not carry all the cameras of a rig at once (Linux; elsewhere nothing)."""
    if sys.platform != "linux":
        return []
    from ipsys_log.capture.usb_bus import find_cameras

    return advise(demands_of(find_cameras(), rig))


def open_source(camera: RigCamera, clock: Clock, say: Say) -> AbstractContextManager[Iterator[Frame | None]]:
    """Open a camera, whatever it is attached by; an :data:`~ipsys_log.capture.frames.Open` itself.

    Raises
    ------
    IpsysError
        Where the rig gives no source, or one that nothing here opens.
    """
    return _opener(camera)(camera, clock, say)


def _opener(camera: RigCamera) -> Open:
    if not camera.source:
        raise IpsysError(
            f'camera {camera.name}: the rig gives no source; write e.g. source = "usb:/dev/video0"'
        )
    shown = hide_password(camera.source)
    if shown == camera.source and (f"{HIDDEN}@" in shown or f"={HIDDEN}" in shown):
        raise IpsysError(
            f"camera {camera.name}: {shown}: its password is not known, a log holds none; write it in place "
            f"of {HIDDEN}"
        )
    opener = OPENERS.get(camera.source.partition(":")[0].lower())
    if opener is None:
        if shown.startswith("/dev/"):
            raise IpsysError(f'camera {camera.name}: source {shown!r}: write it as "usb:{shown}"')
        known = ", ".join(f"{scheme}:" for scheme in OPENERS)
        raise IpsysError(f"camera {camera.name}: source {shown!r} is none of {known}")
    return opener
