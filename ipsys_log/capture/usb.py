"""Cameras on USB: through Video for Linux, elsewhere through OpenCV."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager

from ipsys_log.capture.frames import Clock, Frame, Say
from ipsys_log.messages import RigCamera

__all__ = ["open_usb"]


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
    from ipsys_log.capture.opencv_camera import open_opencv

    return open_opencv(camera, clock, say)
