"""Frames from a camera by Video for Linux, with the driver's stamps: its JPEG bytes, or encoded once."""

from __future__ import annotations

import errno
import mmap
import os
import select
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.capture import v4l2
from ipsys_log.capture.frames import Clock, Frame, Given, Say, SourceError, device_of, say_refused
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S

__all__ = ["RAW_FORMATS", "Layout", "encode_raw", "open_v4l2"]

Plane = NDArray[np.uint8]

# The driver's names, the one that is taken first in front: of those with colour that of the fewest bytes.
RAW_FORMATS = ("NV12", "YUYV", "UYVY", "GREY")
_QUALITY = 95


class Layout(NamedTuple):
    """Of a picture in memory: ``stride`` is how many bytes lie between the beginnings of two rows."""

    format: str
    width: int
    height: int
    stride: int

    @property
    def size(self) -> int:
        """How many bytes a picture takes."""
        rows = self.height + self.height // 2 if self.format == "NV12" else self.height
        return self.stride * rows


def encode_raw(data: bytes, layout: Layout) -> bytes | None:
    """A picture as JPEG, its levels as the camera gave them; None where data is missing.

    Examples
    --------
    >>> encode_raw(bytes(64), Layout("GREY", 8, 8, 8))[:2].hex()
    'ffd8'

    References
    ----------
    https://docs.kernel.org/userspace-api/media/v4l/pixfmt.html
    """
    if len(data) < layout.size:
        return None
    rows = np.frombuffer(data, np.uint8, layout.size).reshape(-1, layout.stride)
    grey, *colour = map(np.ascontiguousarray, _planes(rows, layout))
    encoded: bytes = simplejpeg.encode_jpeg_yuv_planes(grey, *(colour or (None, None)), quality=_QUALITY)
    return encoded


def _planes(rows: Plane, layout: Layout) -> list[Plane]:
    """Brightness and, of colour, the two planes of it, which are smaller."""
    width, height = layout.width, layout.height
    if layout.format == "GREY":
        return [rows[:, :width]]
    if layout.format == "NV12":
        colour = rows[height:, :width]
        return [rows[:height, :width], colour[:, 0::2], colour[:, 1::2]]
    pairs = rows[:, : 2 * width]
    if layout.format == "UYVY":
        return [pairs[:, 1::2], pairs[:, 0::4], pairs[:, 2::4]]
    return [pairs[:, 0::2], pairs[:, 1::4], pairs[:, 3::4]]


# The driver's names of JPEG pictures.
_JPEG = ("MJPG", "JPEG")
_BUFFERS = 8
_TURN_S = 0.4
# A camera that gives no picture for so long has gone, though it may still hand back empty buffers.
_SILENT_S = 5.0
# No camera loses so many frames in a row and is still there.
_COUNTS_ANEW = 10_000

# Controls, by linux/v4l2-controls.h. What sets itself is turned off before the value is set.
_EXPOSURE, _AUTO_EXPOSURE, _MANUAL, _SLOWER_IN_THE_DARK = 0x9A0902, 0x9A0901, 1, 0x9A0903
_FOCUS, _AUTO_FOCUS = 0x9A090A, 0x9A090C
_GAIN, _AUTO_GAIN = 0x980913, 0x980912
_EXPOSURE_UNITS = 10_000  # of 100 us, in a second

_FAULTS = {
    errno.ENOENT: "there is no such device; see: ipsys cameras",
    errno.ENODEV: "has gone; is its cable plugged in?",
    errno.EACCES: "may not be opened; put yourself into the group video, and log in again",
    errno.EBUSY: "is in use by another program; end that first",
    errno.ENOTTY: "is no camera; see: ipsys cameras",
    errno.ENOSPC: "its USB bus has no room left for it; what would fit: ipsys cameras --rig lab.toml",
    errno.EPROTO: "does not answer as a camera should; plug it in anew",
}


@contextmanager
def open_v4l2(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """The frames of a camera, as :data:`~ipsys_log.capture.frames.Open` says.

    Raises
    ------
    SourceError
        Where it cannot be opened; the iterator raises it where the camera has gone.
    """
    path = device_of(camera.source or "")
    where = f"camera {camera.name}: {path}"
    with ExitStack() as stack:
        with _faults(where):
            device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
            stack.callback(os.close, device)
            if not v4l2.is_camera(device):
                raise OSError(errno.ENOTTY, "")
            given, layout = _set_up(device, camera, where)
            say_refused(camera, given, say)
            if layout is not None:
                what = f"its {layout.format} pictures are encoded as JPEG once"
                say(f"camera {camera.name}: gives no MJPG; {what}")
            buffers = _map_buffers(device, stack)
            v4l2.call(device, v4l2.STREAMON, v4l2.Int(v4l2.VIDEO_CAPTURE))
            stack.callback(_stop, device)
        yield _frames(_Capture(camera, where, device, buffers, layout), clock, say)


@contextmanager
def _faults(where: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        said = _FAULTS.get(error.errno or 0, f"cannot be read ({error.strerror}); plug it in anew")
        raise SourceError(f"{where}: {said}") from error


def _set_up(device: int, camera: RigCamera, where: str) -> tuple[Given, Layout | None]:
    """Set a camera to what the rig asks for; what it gives then, and how, if not as JPEG."""
    offers = v4l2.list_formats(device)
    name = next((name for name in (*_JPEG, *RAW_FORMATS) if name in offers), None)
    if name is None:
        raise SourceError(f"{where}: offers only {', '.join(offers)}; a camera that gives MJPG is needed")
    wanted = v4l2.Format(type=v4l2.VIDEO_CAPTURE, pixelformat=v4l2.fourcc(name))
    wanted.width, wanted.height = camera.width or 1920, camera.height or 1080
    has = v4l2.call(device, v4l2.S_FMT, wanted)
    if has.pixelformat != v4l2.fourcc(name):
        raise SourceError(
            f"{where}: does not give {name} at {camera.width} x {camera.height}; take another size"
        )
    if camera.exposure_s is not None:
        _control(device, _SLOWER_IN_THE_DARK, 0)
        _control(device, _AUTO_EXPOSURE, _MANUAL)
    exposure = None if camera.exposure_s is None else camera.exposure_s * _EXPOSURE_UNITS
    exposure = _control(device, _EXPOSURE, exposure)
    for auto, value in ((_AUTO_FOCUS, camera.focus), (_AUTO_GAIN, camera.gain)):
        _control(device, auto, None if value is None else 0)
    given = Given(
        has.width,
        has.height,
        _set_rate(device, camera.rate_hz),
        None if exposure is None else exposure / _EXPOSURE_UNITS,
        _control(device, _FOCUS, camera.focus),
        _control(device, _GAIN, camera.gain),
    )
    if name in _JPEG:
        return given, None
    least = has.width * (2 if name in ("YUYV", "UYVY") else 1)
    return given, Layout(name, has.width, has.height, max(has.bytesperline, least))


def _set_rate(device: int, rate_hz: float | None) -> float | None:
    """Frames per second after they were asked for; None where the driver does not tell."""
    try:
        parameters = v4l2.call(device, v4l2.G_PARM, v4l2.StreamParameters(type=v4l2.VIDEO_CAPTURE))
        if rate_hz is not None and parameters.capability & v4l2.CAN_SET_RATE:
            parameters.numerator, parameters.denominator = 1000, round(1000 * rate_hz)
            v4l2.call(device, v4l2.S_PARM, parameters)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTTY):
            raise
        return None
    return parameters.denominator / parameters.numerator if parameters.numerator else None


def _control(device: int, control: int, value: float | None) -> float | None:
    """A control's value after it was asked for; None where the camera has no such control, or none was."""
    if value is None:
        return None
    try:
        v4l2.call(device, v4l2.S_CTRL, v4l2.Control(control, round(value)))
    except OSError as error:
        # Out of range, read only, or taken care of by the camera: what it is now, is what it gives.
        if error.errno not in (errno.EINVAL, errno.ERANGE, errno.EACCES, errno.EBUSY, errno.EIO, errno.EPERM):
            raise
    try:
        return float(v4l2.call(device, v4l2.G_CTRL, v4l2.Control(control)).value)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EACCES, errno.EIO):
            raise
        return None


def _map_buffers(device: int, stack: ExitStack) -> list[mmap.mmap]:
    """The driver's memory for frames; handed to it, empty."""
    kind = {"type": v4l2.VIDEO_CAPTURE, "memory": v4l2.MMAP}
    granted = v4l2.call(device, v4l2.REQBUFS, v4l2.RequestBuffers(count=_BUFFERS, **kind))
    buffers = []
    for index in range(granted.count):
        place = v4l2.call(device, v4l2.QUERYBUF, v4l2.Buffer(index=index, **kind))
        buffers.append(
            stack.enter_context(
                mmap.mmap(
                    device,
                    place.length,
                    mmap.MAP_SHARED,
                    mmap.PROT_READ | mmap.PROT_WRITE,
                    offset=place.offset,
                )
            )
        )
        v4l2.call(device, v4l2.QBUF, place)
    return buffers


def _stop(device: int) -> None:
    try:
        v4l2.call(device, v4l2.STREAMOFF, v4l2.Int(v4l2.VIDEO_CAPTURE))
    except OSError:
        return  # a camera that has gone has stopped


class _Capture(NamedTuple):
    camera: RigCamera
    where: str
    device: int
    buffers: list[mmap.mmap]
    layout: Layout | None


def _frames(capture: _Capture, clock: Clock, say: Say) -> Iterator[Frame | None]:
    heard_ns, said = clock.now_ns(), False
    last: int | None = None
    while True:
        with _faults(capture.where):
            buffer = _next_buffer(capture.device)
        if buffer is None:
            _check_heard(capture, clock.now_ns() - heard_ns)
            yield None
            continue
        if not said:
            said = True
            _say_stamps(capture.camera, buffer.flags, say)
        stamped = buffer.flags & v4l2.STAMP_CLOCK == v4l2.STAMP_MONOTONIC
        stamp_ns = buffer.seconds * NS_PER_S + buffer.microseconds * 1000
        data = capture.buffers[buffer.index][: buffer.bytesused]
        with _faults(capture.where):
            v4l2.call(capture.device, v4l2.QBUF, buffer)
        # The driver hands back a frame it could make nothing of as an empty one.
        if data and capture.layout is not None:
            data = encode_raw(data, capture.layout) or b""
            if not data:
                say(f"camera {capture.camera.name}: sends pictures that are not whole; they are left out")
        if not data:
            _check_heard(capture, clock.now_ns() - heard_ns)
            yield None
        else:
            missed, last = _missed(last, buffer.sequence), buffer.sequence
            yield Frame(data, "jpeg", clock.of_monotonic_ns(stamp_ns) if stamped else None, missed)
            heard_ns = clock.now_ns()


def _check_heard(capture: _Capture, silent_ns: int) -> None:
    if silent_ns > _SILENT_S * NS_PER_S:
        raise SourceError(f"{capture.where}: sends no frames; plug it in anew, or into another USB port")


def _missed(last: int | None, sequence: int) -> int:
    """Frames between two numbers of 32 bits; none where a driver does not count, or counts anew."""
    between = 0 if last is None else (sequence - last - 1) & 0xFFFF_FFFF
    return between if between < _COUNTS_ANEW else 0


def _next_buffer(device: int) -> v4l2.Buffer | None:
    """The next buffer with a frame; None while none comes."""
    select.select([device], [], [], _TURN_S)
    try:
        return v4l2.call(device, v4l2.DQBUF, v4l2.Buffer(type=v4l2.VIDEO_CAPTURE, memory=v4l2.MMAP))
    except BlockingIOError:
        return None


def _say_stamps(camera: RigCamera, flags: int, say: Say) -> None:
    """What the driver's stamps mean, where the rig says something else, or nothing."""
    head = f"camera {camera.name}: the driver stamps"
    if flags & v4l2.STAMP_CLOCK != v4l2.STAMP_MONOTONIC:
        say(f"{head} by another clock, so frames get the time they arrive at")
        return
    means = "start" if flags & v4l2.STAMP_SOURCE == v4l2.STAMP_OF_START else "end"
    if camera.stamp is None:
        say(f'{head} the {means} of a frame; put into the rig: stamp = "{means}"')
    elif camera.stamp != means:
        say(f"{head} the {means} of a frame, the rig says: {camera.stamp}")
