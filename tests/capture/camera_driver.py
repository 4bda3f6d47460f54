"""A driver for Video for Linux without a camera. It replaces the kernel.

It answers the requests of ``ioctl`` on an open file according to the documentation of the kernel. The file
is real, so that its buffers are mapped like those of a device.
"""

import errno
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from ipsys_log.capture import v4l2

PAGE = 4096
LENGTH = 64 * PAGE


@dataclass
class Driver:
    """A camera with some modes; ``frames`` are its next frames, and an OSError ends it."""

    path: Path
    frames: deque[bytes | OSError] = field(default_factory=deque)
    modes: dict[str, list[tuple[int, int, list[int]]]] = field(
        default_factory=lambda: {
            "YUYV": [(640, 480, [30])],
            "MJPG": [(1920, 1080, [30, 15]), (1280, 720, [60, 30])],
        }
    )
    # minimum, maximum and present value
    controls: dict[int, list[int]] = field(
        default_factory=lambda: {0x9A0902: [1, 5000, 250], 0x9A0901: [0, 3, 3], 0x980913: [0, 100, 50]}
    )
    flags: int = v4l2.STAMP_MONOTONIC | v4l2.STAMP_OF_START
    stamps_ns: list[int] = field(default_factory=list)
    no_room: bool = False
    size: tuple[int, int] = (640, 480)
    rate: tuple[int, int] = (1, 30)
    stride: int = 0
    queued: deque[int] = field(default_factory=deque)
    # Sequence numbers of the next frames, for lost frames or another start.
    numbers: Iterator[int] = field(default_factory=count)
    streaming: bool = False

    def __post_init__(self) -> None:
        self.path.write_bytes(bytes(8 * LENGTH))

    def __call__(self, _device: int, request: int, about: Any, change: bool) -> int:
        assert change
        answers: dict[int, Callable[[Any], None]] = {
            v4l2.QUERYCAP: self.tell, v4l2.ENUM_FMT: self.tell_format, v4l2.S_FMT: self.set_size,
            v4l2.ENUM_FRAMESIZES: self.tell_size, v4l2.ENUM_FRAMEINTERVALS: self.tell_interval,
            v4l2.G_PARM: self.tell_rate, v4l2.S_PARM: self.set_rate,
            v4l2.G_CTRL: self.tell_control, v4l2.S_CTRL: self.set_control,
            v4l2.REQBUFS: self.grant, v4l2.QUERYBUF: self.place, v4l2.QBUF: self.queue,
            v4l2.DQBUF: self.hand_over, v4l2.STREAMON: self.start, v4l2.STREAMOFF: self.stop,
        }  # fmt: skip
        answers[request](about)
        return 0

    def tell(self, about: v4l2.Capability) -> None:
        about.card, about.driver = b"Lab Camera", b"uvcvideo"
        about.capabilities = v4l2.HAS_DEVICE_CAPS | 0x1
        about.device_caps = v4l2.CAN_CAPTURE | v4l2.CAN_STREAM

    def tell_format(self, about: v4l2.FormatDescription) -> None:
        about.pixelformat = v4l2.fourcc(_at(list(self.modes), about.index))

    def tell_size(self, about: v4l2.FrameSize) -> None:
        width, height, _ = _at(self.modes[v4l2.fourcc_name(about.pixel_format)], about.index)
        about.type, about.sides[0], about.sides[1] = v4l2.DISCRETE, width, height

    def tell_interval(self, about: v4l2.FrameInterval) -> None:
        sizes = self.modes[v4l2.fourcc_name(about.pixel_format)]
        rates = next(rates for *size, rates in sizes if size == [about.width, about.height])
        about.type, about.times[0], about.times[1] = v4l2.DISCRETE, 1, _at(rates, about.index)

    def set_size(self, about: v4l2.Format) -> None:
        """Return the nearest mode, as the documentation requires."""
        sizes = [(w, h) for w, h, _ in self.modes[v4l2.fourcc_name(about.pixelformat)]]
        self.size = min(sizes, key=lambda size: abs(size[0] - about.width) + abs(size[1] - about.height))
        about.width, about.height = self.size
        about.bytesperline = self.stride

    def tell_rate(self, about: v4l2.StreamParameters) -> None:
        about.capability = v4l2.CAN_SET_RATE
        about.numerator, about.denominator = self.rate

    def set_rate(self, about: v4l2.StreamParameters) -> None:
        wanted = about.denominator / about.numerator
        rates = next(rates for sizes in self.modes.values() for w, h, rates in sizes if (w, h) == self.size)
        self.rate = (1, min(rates, key=lambda rate: abs(rate - wanted)))
        about.numerator, about.denominator = self.rate

    def tell_control(self, about: v4l2.Control) -> None:
        if about.id not in self.controls:
            raise OSError(errno.EINVAL, "no such control")
        about.value = self.controls[about.id][2]

    def set_control(self, about: v4l2.Control) -> None:
        if about.id not in self.controls:
            raise OSError(errno.EINVAL, "no such control")
        low, high, _ = self.controls[about.id]
        self.controls[about.id][2] = min(max(about.value, low), high)

    def grant(self, about: v4l2.RequestBuffers) -> None:
        about.count = min(about.count, 4)

    def place(self, about: v4l2.Buffer) -> None:
        about.offset, about.length = about.index * LENGTH, LENGTH

    def queue(self, about: v4l2.Buffer) -> None:
        assert about.index not in self.queued
        self.queued.append(about.index)

    def start(self, about: v4l2.Int) -> None:
        assert about.value == v4l2.VIDEO_CAPTURE
        if self.no_room:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.streaming = True

    def stop(self, _about: v4l2.Int) -> None:
        self.streaming = False

    def hand_over(self, about: v4l2.Buffer) -> None:
        assert self.streaming
        if not self.frames:
            time.sleep(0.05)
            raise BlockingIOError(errno.EAGAIN, "nothing yet")
        frame = self.frames.popleft()
        if isinstance(frame, OSError):
            raise frame
        index = self.queued.popleft()
        with self.path.open("r+b") as file:
            file.seek(index * LENGTH)
            file.write(frame)
        stamp_ns = time.monotonic_ns()
        self.stamps_ns.append(stamp_ns)
        about.index, about.bytesused, about.flags = index, len(frame), self.flags
        about.sequence = next(self.numbers)
        about.seconds, about.microseconds = stamp_ns // 10**9, stamp_ns % 10**9 // 1000


def _at(items: list[Any], index: int) -> Any:
    if index >= len(items):
        raise OSError(errno.EINVAL, "no more")
    return items[index]
