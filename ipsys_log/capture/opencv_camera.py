"""Cameras through OpenCV, where there is no Video for Linux."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
import simplejpeg

from ipsys_log.capture.asked import Given, say_refused
from ipsys_log.capture.frames import Clock, Frame, Say, SourceError
from ipsys_log.messages import RigCamera

__all__ = ["open_opencv"]

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
