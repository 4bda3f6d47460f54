"""Requests and structures of Video for Linux, version 2, as in ``linux/videodev2.h`` for 64 bits.

References
----------
https://docs.kernel.org/userspace-api/media/v4l/v4l2.html
"""

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
# Flags of a buffer: the clock of its stamp, and the instant of its stamp.
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
    """A frame size.

    For a discrete type, ``sides`` is width and height. Else it is the minimum, maximum and step of both.
    """

    _fields_ = (
        ("index", c_uint32), ("pixel_format", c_uint32), ("type", c_uint32),
        ("sides", c_uint32 * 6), ("_", c_uint32 * 2),
    )  # fmt: skip


class FrameInterval(ctypes.Structure):
    """A frame interval.

    For a discrete type, ``times`` is the numerator and the denominator of the interval in s. Else it is the
    same for the minimum, the maximum and the step.
    """

    _fields_ = (
        ("index", c_uint32), ("pixel_format", c_uint32), ("width", c_uint32), ("height", c_uint32),
        ("type", c_uint32), ("times", c_uint32 * 6), ("_", c_uint32 * 2),
    )  # fmt: skip


class Format(ctypes.Structure):
    # The fields after "_" are a union with pointers, which begins at byte 8.
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
    """Return the number of a request as in ``asm-generic/ioctl.h``; direction 1 is write, 2 is read."""
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


def send_request(device: int, request: int, struct: Struct) -> Struct:
    """Send a request to an open device; the driver writes its answer into ``struct``.

    Raises
    ------
    OSError
        The driver reports an error.
    """
    ioctl(device, request, struct, True)
    return struct


def fourcc(name: str) -> int:
    """Return the number of a pixel format.

    Examples
    --------
    >>> fourcc_name(fourcc("MJPG"))
    'MJPG'
    """
    return int.from_bytes(name.encode("ascii"), "little")


def fourcc_name(number: int) -> str:
    """Return the name of a pixel format."""
    return number.to_bytes(4, "little").decode("ascii", "replace").strip()


def is_camera(device: int) -> bool:
    """Return whether an open device delivers images; a camera also has devices for other purposes."""
    try:
        capability = send_request(device, QUERYCAP, Capability())
    except OSError as error:
        if error.errno in (errno.ENOTTY, errno.EINVAL):
            return False
        raise
    flags = capability.device_caps if capability.capabilities & HAS_DEVICE_CAPS else capability.capabilities
    return bool(flags & CAN_CAPTURE and flags & CAN_STREAM)


def list_formats(device: int) -> list[str]:
    """List the names of the pixel formats of an open device."""
    kinds = enumerate_items(
        device, ENUM_FMT, lambda index: FormatDescription(index=index, type=VIDEO_CAPTURE)
    )
    return [fourcc_name(kind.pixelformat) for kind in kinds]


def enumerate_items(device: int, request: int, make_query: Callable[[int], Struct]) -> Iterator[Struct]:
    """Yield the answers of a driver for the indices 0, 1, 2 and so on, until there are no more."""
    for index in count():
        try:
            yield send_request(device, request, make_query(index))
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return
            raise
