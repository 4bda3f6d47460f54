"""Which opener a camera's ``source`` in the rig is for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager

from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera
from ipsys_log.sources.frames import Clock, Frame, Open, Say
from ipsys_log.sources.network import open_network
from ipsys_log.sources.played import open_played
from ipsys_log.sources.simulated import open_simulated
from ipsys_log.sources.usb import open_usb

__all__ = ["OPENERS", "open_source"]

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


def open_source(camera: RigCamera, clock: Clock, say: Say) -> AbstractContextManager[Iterator[Frame | None]]:
    """Open a camera, whatever it is attached by; an :data:`~ipsys_log.sources.frames.Open` itself.

    Raises
    ------
    IpsysError
        Where the rig gives no source, or one that nothing here opens.
    """
    if not camera.source:
        raise IpsysError(
            f'camera {camera.name}: the rig gives no source; write e.g. source = "usb:/dev/video0"'
        )
    opener = OPENERS.get(camera.source.partition(":")[0].lower())
    if opener is None:
        known = ", ".join(f"{scheme}:" for scheme in OPENERS)
        raise IpsysError(f"camera {camera.name}: source {camera.source!r} is none of {known}")
    return opener(camera, clock, say)
