"""The functions that open a camera by its ``source`` in the rig: USB, network, files, simulation."""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from ipsys_log.capture.frames import (
    ActualSettings,
    Clock,
    Frame,
    Open,
    Say,
    SourceError,
    SourceMessage,
    device_path,
    report_refused_settings,
)
from ipsys_log.capture.network import check_address, open_network
from ipsys_log.capture.nodes.centre import is_of_node, node_of
from ipsys_log.capture.nodes.network import read_network
from ipsys_log.capture.nodes.receiver import Receiver
from ipsys_log.capture.simulated import open_simulated, parse_source
from ipsys_log.capture.usb_bus import advise_bandwidth, list_demands
from ipsys_log.capture.video_files import check_playback_source, open_playback
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.plain_text import HIDDEN, hide_password

_QUALITY = 92


@contextmanager
def open_opencv(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:  # noqa: ARG001
    """Open camera ``usb:0``, ``usb:1`` and so on; OpenCV decodes the frames, and they are encoded as JPEG."""
    number = (camera.source or "").partition(":")[2]
    if not number.isdecimal():
        raise SourceError(
            f"camera {camera.name}: {camera.source}: this system numbers its cameras; write usb:0 or usb:1"
        )
    device = cv2.VideoCapture(int(number))
    try:
        if not device.isOpened():
            raise SourceError(
                f"camera {camera.name}: camera number {number} does not exist, or another program uses it"
            )
        report_refused_settings(camera, _set(device, camera), say)
        say(
            f"camera {camera.name}: this system gives only decoded images; ipsys encodes them as JPEG again, "
            "with their time of arrival"
        )
        yield _frames(device, f"camera {camera.name}: {camera.source}")
    finally:
        device.release()


def _set(device: cv2.VideoCapture, camera: RigCamera) -> ActualSettings:
    """Set a camera to the settings of the rig, and return its actual settings."""
    device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    for key, value in (
        (cv2.CAP_PROP_AUTOFOCUS, camera.focus),
        (cv2.CAP_PROP_AUTO_EXPOSURE, camera.exposure_s),
    ):
        if value is not None:
            device.set(key, 0.0)
    # The drivers take log2 of the exposure in s.
    exposure = None if camera.exposure_s is None else float(np.log2(camera.exposure_s))
    requested = {
        cv2.CAP_PROP_FRAME_WIDTH: camera.width,
        cv2.CAP_PROP_FRAME_HEIGHT: camera.height,
        cv2.CAP_PROP_FPS: camera.rate_hz,
        cv2.CAP_PROP_EXPOSURE: exposure,
        cv2.CAP_PROP_FOCUS: camera.focus,
        cv2.CAP_PROP_GAIN: camera.gain,
    }
    accepted = {key: value is not None and device.set(key, float(value)) for key, value in requested.items()}
    actual = {key: device.get(key) for key in requested}
    return ActualSettings(
        int(actual[cv2.CAP_PROP_FRAME_WIDTH]),
        int(actual[cv2.CAP_PROP_FRAME_HEIGHT]),
        actual[cv2.CAP_PROP_FPS] or None,
        2.0 ** actual[cv2.CAP_PROP_EXPOSURE] if accepted[cv2.CAP_PROP_EXPOSURE] else None,
        actual[cv2.CAP_PROP_FOCUS] if accepted[cv2.CAP_PROP_FOCUS] else None,
        actual[cv2.CAP_PROP_GAIN] if accepted[cv2.CAP_PROP_GAIN] else None,
    )


def _frames(device: cv2.VideoCapture, label: str) -> Iterator[Frame | None]:
    while True:
        success, image = device.read()
        if not success:
            raise SourceError(f"{label}: sends no frames; plug it in again, or into another USB port")
        data = simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=_QUALITY, colorspace="BGR")
        yield Frame(data, "jpeg", None)


_SYSTEM: str = sys.platform


def open_usb(camera: RigCamera, clock: Clock, say: Say) -> AbstractContextManager[Iterator[Frame | None]]:
    """Open a camera on USB; an :data:`~ipsys_log.capture.frames.Open`.

    On Linux, the frames are the camera's own JPEG bytes, with the driver's stamp. On Windows and macOS,
    OpenCV gives decoded images. They are encoded once, and have no stamps.

    Parameters
    ----------
    camera : its ``source`` is ``usb:`` and a device (``usb:/dev/video0``) or its number (``usb:0``).
    clock : converts the driver's stamps to UTC.
    say : called with each setting that the camera refused.
    """
    # With sys.platform itself, the type checker would skip the code of the other systems.
    if _SYSTEM == "linux":
        from ipsys_log.capture.v4l2_camera import open_v4l2

        return open_v4l2(camera, clock, say)

    return open_opencv(camera, clock, say)


def _refuse_node(
    camera: RigCamera,
    clock: Clock,  # noqa: ARG001
    say: Say,  # noqa: ARG001
) -> AbstractContextManager[Iterator[Frame | None]]:
    """Refuse the camera of a node that is opened without its rig."""
    raise IpsysError(
        f"camera {camera.name}: {camera.source} is the camera of a node, which this step cannot open; use the"
        " commands record, live, measure, align or calibrate"
    )


# The functions by the text before the first colon of a source.
OPENERS: dict[str, Open] = {
    "http": open_network,
    "https": open_network,
    "rtsp": open_network,
    "rtsps": open_network,
    "tcp": open_network,
    "udp": open_network,
    "usb": open_usb,
    "sim": open_simulated,
    "file": open_playback,
    "zenoh": _refuse_node,
}


@contextmanager
def source_opener(
    rig: Rig, cameras: Sequence[RigCamera], folder: Path, is_stopped: Callable[[], bool] = lambda: False
) -> Iterator[Open]:
    """Yield the function that opens the cameras of a rig; all cameras of nodes share one session.

    Parameters
    ----------
    folder : the folder of the rig file, in which the rig names certificates.
    is_stopped : ends the wait for a node.
    """
    of_nodes = [camera for camera in cameras if is_of_node(camera)]
    if not of_nodes:
        yield open_source
        return
    check_installed(f"camera {of_nodes[0].name}: the source {of_nodes[0].source} needs", "zenoh")
    with Receiver(of_nodes, read_network(rig.nodes, folder), version("ipsys_log"), is_stopped) as receiver:
        yield receiver.choose_opener(open_source)


def check_sources(cameras: Sequence[RigCamera]) -> None:
    """Check the source of each camera without opening it: its text, its file or its device."""
    _check_devices(cameras)
    for camera in cameras:
        source = str(camera.source)
        if _opener(camera) is open_network:
            check_address(camera)
        elif _opener(camera) is open_simulated:
            parse_source(camera)
        elif _opener(camera) is open_playback:
            check_playback_source(camera)
        elif is_of_node(camera):
            node_of(camera)
        elif sys.platform == "linux" and not Path(device_path(source)).exists():
            raise IpsysError(
                f"camera {camera.name}: device {device_path(source)!r} does not exist; 'ipsys cameras' "
                "lists the attached cameras"
            )


def _check_devices(cameras: Iterable[RigCamera]) -> None:
    """Check that no two cameras are the same device, also under different names of the device."""
    names: dict[Path, str] = {}
    for camera in cameras:
        if camera.source and camera.source.startswith("usb:"):
            device = Path(device_path(camera.source)).resolve()
            other = names.setdefault(device, camera.name)
            if other != camera.name:
                raise IpsysError(
                    f"cameras {other} and {camera.name} have the same device, {device}; give each its own"
                )


def usb_advice(rig: Rig) -> list[str]:
    """Return advice if a USB bus cannot carry all cameras of a rig at once (Linux only; elsewhere empty)."""
    if sys.platform != "linux":
        return []
    from ipsys_log.capture.usb_bus import find_cameras

    return advise_bandwidth(list_demands(find_cameras(), rig))


def open_source(
    camera: RigCamera, clock: Clock, say: Say
) -> AbstractContextManager[Iterator[Frame | SourceMessage | None]]:
    """Open a camera of any kind; an :data:`~ipsys_log.capture.frames.Open`."""
    return _opener(camera)(camera, clock, say)


def _opener(camera: RigCamera) -> Open:
    if not camera.source:
        raise IpsysError(
            f'camera {camera.name}: has no source in the rig; write, for example, source = "usb:/dev/video0"'
        )
    shown = hide_password(camera.source)
    if shown == camera.source and (f"{HIDDEN}@" in shown or f"={HIDDEN}" in shown):
        raise IpsysError(
            f"camera {camera.name}: {shown}: its password is missing, because a log holds none; replace "
            f"{HIDDEN} by the password"
        )
    opener = OPENERS.get(camera.source.partition(":")[0].lower())
    if opener is None:
        if shown.startswith("/dev/"):
            raise IpsysError(f'camera {camera.name}: source {shown!r}: has no type; write "usb:{shown}"')
        schemes = ", ".join(f"{scheme}:" for scheme in OPENERS)
        raise IpsysError(f"camera {camera.name}: source {shown!r} has an unknown type; use one of {schemes}")
    return opener
