"""Video for Linux, version 2: its requests and structures, as ``linux/videodev2.h`` has them for 64 bits.

References
----------
https://docs.kernel.org/userspace-api/media/v4l/v4l2.html
"""

from __future__ import annotations

import ctypes
import errno
from collections.abc import Callable, Iterator
from ctypes import c_char, c_int32, c_int64, c_uint8, c_uint32, c_uint64
from fcntl import ioctl
from itertools import count
from typing import TypeVar

VIDEO_CAPTURE = 1
MMAP = 1
CAN_CAPTURE, CAN_STREAM, HAS_DEVICE_CAPS = 0x1, 0x0400_0000, 0x8000_0000
CAN_SET_RATE = 0x1000
# Of the flags of a buffer: which clock its stamp is of, and of which instant.
STAMP_CLOCK, STAMP_MONOTONIC = 0xE000, 0x2000
STAMP_SOURCE, STAMP_OF_START = 0x7_0000, 0x1_0000
DISCRETE = 1

Struct = TypeVar("Struct", bound=ctypes.Structure)


class Capability(ctypes.Structure):
    _fields_ = (
        ("driver", c_char * 16), ("card", c_char * 32), ("bus_info", c_char * 32),
        ("version", c_uint32), ("capabilities", c_uint32), ("device_caps", c_uint32), ("_", c_uint32 * 3),
    )  # fmt: skip


class FormatDescription(ctypes.Structure):
    _fields_ = (
        ("index", c_uint32), ("type", c_uint32), ("flags", c_uint32), ("description", c_char * 32),
        ("pixelformat", c_uint32), ("mbus_code", c_uint32), ("_", c_uint32 * 3),
    )  # fmt: skip


class FrameSize(ctypes.Structure):
    """``sides`` is width and height or, where the type is not discrete, least, most and step of both."""

    _fields_ = (
        ("index", c_uint32), ("pixel_format", c_uint32), ("type", c_uint32),
        ("sides", c_uint32 * 6), ("_", c_uint32 * 2),
    )  # fmt: skip


class FrameInterval(ctypes.Structure):
    """``times`` is numerator and denominator, in s; where the type is not discrete, of least, most, step."""

    _fields_ = (
        ("index", c_uint32), ("pixel_format", c_uint32), ("width", c_uint32), ("height", c_uint32),
        ("type", c_uint32), ("times", c_uint32 * 6), ("_", c_uint32 * 2),
    )  # fmt: skip


class Format(ctypes.Structure):
    # A union with pointers in it: it begins at 8.
    _fields_ = (
        ("type", c_uint32), ("_", c_uint32), ("width", c_uint32), ("height", c_uint32),
        ("pixelformat", c_uint32), ("field", c_uint32), ("bytesperline", c_uint32),
        ("sizeimage", c_uint32), ("__", c_uint8 * 176),
    )  # fmt: skip


class StreamParameters(ctypes.Structure):
    _fields_ = (
        ("type", c_uint32), ("capability", c_uint32), ("capturemode", c_uint32),
        ("numerator", c_uint32), ("denominator", c_uint32), ("_", c_uint8 * 184),
    )  # fmt: skip


class RequestBuffers(ctypes.Structure):
    _fields_ = (("count", c_uint32), ("type", c_uint32), ("memory", c_uint32), ("_", c_uint32 * 2))


class Buffer(ctypes.Structure):
    _fields_ = (
        ("index", c_uint32), ("type", c_uint32), ("bytesused", c_uint32), ("flags", c_uint32),
        ("field", c_uint32), ("seconds", c_int64), ("microseconds", c_int64), ("timecode", c_uint8 * 16),
        ("sequence", c_uint32), ("memory", c_uint32), ("offset", c_uint64), ("length", c_uint32),
        ("_", c_uint32 * 2),
    )  # fmt: skip


class Control(ctypes.Structure):
    _fields_ = (("id", c_uint32), ("value", c_int32))


class Int(ctypes.Structure):
    _fields_ = (("value", c_int32),)


def _request(direction: int, number: int, kind: type[ctypes.Structure]) -> int:
    """As ``asm-generic/ioctl.h`` makes it: 1 for what is written, 2 for what is read."""
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


QUERYCAP = _request(2, 0, Capability)
ENUM_FMT = _request(3, 2, FormatDescription)
S_FMT = _request(3, 5, Format)
REQBUFS = _request(3, 8, RequestBuffers)
QUERYBUF = _request(3, 9, Buffer)
QBUF = _request(3, 15, Buffer)
DQBUF = _request(3, 17, Buffer)
STREAMON = _request(1, 18, Int)
STREAMOFF = _request(1, 19, Int)
G_PARM = _request(3, 21, StreamParameters)
S_PARM = _request(3, 22, StreamParameters)
G_CTRL = _request(3, 27, Control)
S_CTRL = _request(3, 28, Control)
ENUM_FRAMESIZES = _request(3, 74, FrameSize)
ENUM_FRAMEINTERVALS = _request(3, 75, FrameInterval)


def call(device: int, request: int, struct: Struct) -> Struct:
    """Put a request to an open device; what it answers stands in ``struct``.

    Raises
    ------
    OSError
        As the driver says.
    """
    ioctl(device, request, struct, True)
    return struct


def fourcc(name: str) -> int:
    """A pixel format's number.

    Examples
    --------
    >>> fourcc_name(fourcc("MJPG"))
    'MJPG'
    """
    return int.from_bytes(name.encode("ascii"), "little")


def fourcc_name(number: int) -> str:
    """A pixel format's name."""
    return number.to_bytes(4, "little").decode("ascii", "replace").strip()


def is_camera(device: int) -> bool:
    """Whether an open device hands over pictures; a camera has devices for other things too."""
    try:
        known = call(device, QUERYCAP, Capability())
    except OSError as error:
        if error.errno in (errno.ENOTTY, errno.EINVAL):
            return False
        raise
    has = known.device_caps if known.capabilities & HAS_DEVICE_CAPS else known.capabilities
    return bool(has & CAN_CAPTURE and has & CAN_STREAM)


def list_formats(device: int) -> list[str]:
    """Names of the pixel formats of an open device."""
    kinds = each(device, ENUM_FMT, lambda index: FormatDescription(index=index, type=VIDEO_CAPTURE))
    return [fourcc_name(kind.pixelformat) for kind in kinds]


def each(device: int, request: int, at: Callable[[int], Struct]) -> Iterator[Struct]:
    """What a driver counts up, until it says that there are no more."""
    for index in count():
        try:
            yield call(device, request, at(index))
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return
            raise
