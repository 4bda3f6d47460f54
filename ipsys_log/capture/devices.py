"""The openers of cameras by the ``source`` in the rig: USB, network, files, simulation."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from ipsys_log.capture.frames import Clock, Frame, Given, Open, Say, SourceError, device_of, say_refused
from ipsys_log.capture.network import check_address, open_network
from ipsys_log.capture.simulated import open_simulated, parse_source
from ipsys_log.capture.usb_bus import advise, demands_of
from ipsys_log.capture.video_files import check_played, open_played
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.rig.file import HIDDEN, hide_password

__all__ = [
    "OPENERS",
    "check_devices",
    "check_sources",
    "open_opencv",
    "open_source",
    "open_usb",
    "usb_advice",
]

_QUALITY = 92


@contextmanager
def open_opencv(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:  # noqa: ARG001
    """The frames of camera ``usb:0``, ``usb:1`` and so on, decoded by OpenCV and encoded once as JPEG.

    Raises
    ------
    SourceError
        Where there is no such camera; the iterator raises it where the camera has gone.
    """
    number = (camera.source or "").partition(":")[2]
    if not number.isdecimal():
        raise SourceError(f"camera {camera.name}: {camera.source}: here a camera has a number: usb:0, usb:1")
    device = cv2.VideoCapture(int(number))
    try:
        if not device.isOpened():
            raise SourceError(f"camera {camera.name}: there is no camera {number}, or another program has it")
        say_refused(camera, _set(device, camera), say)
        say(
            f"camera {camera.name}: this system hands over decoded pictures; they are encoded as JPEG again, "
            "and get their time of arrival"
        )
        yield _frames(device, f"camera {camera.name}: {camera.source}")
    finally:
        device.release()


def _set(device: cv2.VideoCapture, camera: RigCamera) -> Given:
    """Ask for what the rig wants, and read back what is."""
    device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    for key, value in (
        (cv2.CAP_PROP_AUTOFOCUS, camera.focus),
        (cv2.CAP_PROP_AUTO_EXPOSURE, camera.exposure_s),
    ):
        if value is not None:
            device.set(key, 0.0)
    # Drivers take an exposure as a power of two, of s.
    exposure = None if camera.exposure_s is None else float(np.log2(camera.exposure_s))
    asked = {
        cv2.CAP_PROP_FRAME_WIDTH: camera.width,
        cv2.CAP_PROP_FRAME_HEIGHT: camera.height,
        cv2.CAP_PROP_FPS: camera.rate_hz,
        cv2.CAP_PROP_EXPOSURE: exposure,
        cv2.CAP_PROP_FOCUS: camera.focus,
        cv2.CAP_PROP_GAIN: camera.gain,
    }
    taken = {key: value is not None and device.set(key, float(value)) for key, value in asked.items()}
    has = {key: device.get(key) for key in asked}
    return Given(
        int(has[cv2.CAP_PROP_FRAME_WIDTH]),
        int(has[cv2.CAP_PROP_FRAME_HEIGHT]),
        has[cv2.CAP_PROP_FPS] or None,
        2.0 ** has[cv2.CAP_PROP_EXPOSURE] if taken[cv2.CAP_PROP_EXPOSURE] else None,
        has[cv2.CAP_PROP_FOCUS] if taken[cv2.CAP_PROP_FOCUS] else None,
        has[cv2.CAP_PROP_GAIN] if taken[cv2.CAP_PROP_GAIN] else None,
    )


def _frames(device: cv2.VideoCapture, where: str) -> Iterator[Frame | None]:
    while True:
        came, picture = device.read()
        if not came:
            raise SourceError(f"{where}: sends no frames; plug it in anew, or into another USB port")
        data = simplejpeg.encode_jpeg(np.ascontiguousarray(picture), quality=_QUALITY, colorspace="BGR")
        yield Frame(data, "jpeg", None)


_SYSTEM: str = sys.platform


def open_usb(camera: RigCamera, clock: Clock, say: Say) -> AbstractContextManager[Iterator[Frame | None]]:
    """The frames of a camera on USB, as :data:`~ipsys_log.capture.frames.Open` says.

    On Linux they are the camera's own JPEG bytes, with the driver's stamp. On Windows and macOS OpenCV
    hands over pictures, which are encoded once, without stamps.

    Parameters
    ----------
    camera : its ``source`` is ``usb:`` and a device (``usb:/dev/video0``) or its number (``usb:0``).
    clock : turns the driver's stamps into UTC.
    say : told what the camera refused.

    Raises
    ------
    SourceError
        Where there is no such camera, or it is in use, or may not be opened.
    """
    # By a name, or the type checker would pass over what is not for its own system.
    if _SYSTEM == "linux":
        from ipsys_log.capture.v4l2_camera import open_v4l2

        return open_v4l2(camera, clock, say)

    return open_opencv(camera, clock, say)


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
