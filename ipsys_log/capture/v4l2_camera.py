"""Frames of a camera by Video for Linux, with the driver's stamps: its JPEG bytes, or encoded once."""

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
from ipsys_log.capture.frames import (
    ActualSettings,
    Clock,
    Frame,
    Say,
    SourceError,
    device_path,
    report_refused_settings,
)
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S

# The driver's names of JPEG images.
_JPEG = ("MJPG", "JPEG")
_BUFFERS = 8
_TURN_S = 0.4
# A camera that sends no image for this time is disconnected. It may still return empty buffers.
_SILENT_S = 5.0
# A larger gap of the frame numbers means that the driver counts from the start again. No connected camera
# loses so many frames in a row.
_COUNTS_ANEW = 10_000

# Controls, by linux/v4l2-controls.h. An automatic control is turned off before its value is set.
_EXPOSURE, _AUTO_EXPOSURE, _MANUAL, _SLOWER_IN_THE_DARK = 0x9A0902, 0x9A0901, 1, 0x9A0903
_FOCUS, _AUTO_FOCUS = 0x9A090A, 0x9A090C
_GAIN, _AUTO_GAIN = 0x980913, 0x980912
_EXPOSURE_UNITS = 10_000  # of 100 us, in a second

_FAULTS = {
    errno.ENOENT: "does not exist; to list the cameras: ipsys cameras",
    errno.ENODEV: "is disconnected; check its cable",
    errno.EACCES: "cannot be opened: no permission; add your user to the group video, and log in again",
    errno.EBUSY: "is in use by another program; close that program",
    errno.ENOTTY: "is not a camera; to list the cameras: ipsys cameras",
    errno.ENOSPC: "its USB bus has too little bandwidth; for advice: ipsys cameras --rig lab.toml",
    errno.EPROTO: "does not answer like a camera; plug it in again",
}
_Plane = NDArray[np.uint8]

# The driver's names of raw formats, in order of preference. The colour format with the fewest bytes is first.
_RAW_FORMATS = ("NV12", "YUYV", "UYVY", "GREY")
_QUALITY = 95


@contextmanager
def open_v4l2(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """Open a camera; an :data:`~ipsys_log.capture.frames.Open`."""
    path = device_path(camera.source or "")
    label = f"camera {camera.name}: {path}"
    with ExitStack() as stack:
        with _faults(label):
            device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
            stack.callback(os.close, device)
            if not v4l2.is_camera(device):
                raise OSError(errno.ENOTTY, "")
            actual, layout = _set_up(device, camera, label)
            report_refused_settings(camera, actual, say)
            if layout is not None:
                note = f"ipsys encodes its {layout.format} images as JPEG"
                say(f"camera {camera.name}: gives no MJPG; {note}")
            buffers = _map_buffers(device, stack)
            v4l2.send_request(device, v4l2.STREAMON, v4l2.Int(v4l2.VIDEO_CAPTURE))
            stack.callback(_stop, device)
        yield _frames(_Capture(camera, label, device, buffers, layout), clock, say)


@contextmanager
def _faults(label: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        message = _FAULTS.get(error.errno or 0, f"cannot be read ({error.strerror}); plug it in again")
        raise SourceError(f"{label}: {message}") from error


def _set_up(device: int, camera: RigCamera, label: str) -> "tuple[ActualSettings, _ImageLayout | None]":
    """Set a camera to the settings of the rig; return its actual settings, and the layout of raw images."""
    offers = v4l2.list_formats(device)
    name = next((name for name in (*_JPEG, *_RAW_FORMATS) if name in offers), None)
    if name is None:
        raise SourceError(f"{label}: has only {', '.join(offers)}; use a camera with MJPG")
    requested = v4l2.Format(type=v4l2.VIDEO_CAPTURE, pixelformat=v4l2.fourcc(name))
    requested.width, requested.height = camera.width or 1920, camera.height or 1080
    format = v4l2.send_request(device, v4l2.S_FMT, requested)
    if format.pixelformat != v4l2.fourcc(name):
        raise SourceError(
            f"{label}: does not have {name} at {camera.width} x {camera.height}; set another size"
        )
    if camera.exposure_s is not None:
        _control(device, _SLOWER_IN_THE_DARK, 0)
        _control(device, _AUTO_EXPOSURE, _MANUAL)
    exposure = None if camera.exposure_s is None else camera.exposure_s * _EXPOSURE_UNITS
    exposure = _control(device, _EXPOSURE, exposure)
    for auto, value in ((_AUTO_FOCUS, camera.focus), (_AUTO_GAIN, camera.gain)):
        _control(device, auto, None if value is None else 0)
    actual = ActualSettings(
        format.width,
        format.height,
        _set_rate(device, camera.rate_hz),
        None if exposure is None else exposure / _EXPOSURE_UNITS,
        _control(device, _FOCUS, camera.focus),
        _control(device, _GAIN, camera.gain),
    )
    if name in _JPEG:
        return actual, None
    least = format.width * (2 if name in ("YUYV", "UYVY") else 1)
    return actual, _ImageLayout(name, format.width, format.height, max(format.bytesperline, least))


def _set_rate(device: int, rate_hz: float | None) -> float | None:
    """Set the frame rate, and return the actual rate in Hz; None if the driver does not give it."""
    try:
        parameters = v4l2.send_request(device, v4l2.G_PARM, v4l2.StreamParameters(type=v4l2.VIDEO_CAPTURE))
        if rate_hz is not None and parameters.capability & v4l2.CAN_SET_RATE:
            parameters.numerator, parameters.denominator = 1000, round(1000 * rate_hz)
            v4l2.send_request(device, v4l2.S_PARM, parameters)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTTY):
            raise
        return None
    return parameters.denominator / parameters.numerator if parameters.numerator else None


def _control(device: int, control: int, value: float | None) -> float | None:
    """Set a control, and return its actual value; None if ``value`` is None or the control is missing."""
    if value is None:
        return None
    try:
        v4l2.send_request(device, v4l2.S_CTRL, v4l2.Control(control, round(value)))
    except OSError as error:
        # The value is out of range, or the control is read-only or automatic.
        # The result is its present value.
        if error.errno not in (errno.EINVAL, errno.ERANGE, errno.EACCES, errno.EBUSY, errno.EIO, errno.EPERM):
            raise
    try:
        return float(v4l2.send_request(device, v4l2.G_CTRL, v4l2.Control(control)).value)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EACCES, errno.EIO):
            raise
        return None


def _map_buffers(device: int, stack: ExitStack) -> list[mmap.mmap]:
    """Map the driver's frame buffers into memory, and give them to the driver, empty."""
    kind = {"type": v4l2.VIDEO_CAPTURE, "memory": v4l2.MMAP}
    granted = v4l2.send_request(device, v4l2.REQBUFS, v4l2.RequestBuffers(count=_BUFFERS, **kind))
    buffers = []
    for index in range(granted.count):
        buffer = v4l2.send_request(device, v4l2.QUERYBUF, v4l2.Buffer(index=index, **kind))
        buffers.append(
            stack.enter_context(
                mmap.mmap(
                    device,
                    buffer.length,
                    mmap.MAP_SHARED,
                    mmap.PROT_READ | mmap.PROT_WRITE,
                    offset=buffer.offset,
                )
            )
        )
        v4l2.send_request(device, v4l2.QBUF, buffer)
    return buffers


def _stop(device: int) -> None:
    try:
        v4l2.send_request(device, v4l2.STREAMOFF, v4l2.Int(v4l2.VIDEO_CAPTURE))
    except OSError:
        return  # a disconnected camera has stopped already


class _Capture(NamedTuple):
    camera: RigCamera
    label: str
    device: int
    buffers: list[mmap.mmap]
    layout: "_ImageLayout | None"


def _frames(capture: _Capture, clock: Clock, say: Say) -> Iterator[Frame | None]:
    heard_ns, reported = clock.now_ns(), False
    last: int | None = None
    while True:
        with _faults(capture.label):
            buffer = _next_buffer(capture.device)
        if buffer is None:
            _check_heard(capture, clock.now_ns() - heard_ns)
            yield None
            continue
        if not reported:
            reported = True
            _say_stamps(capture.camera, buffer.flags, say)
        stamped = buffer.flags & v4l2.STAMP_CLOCK == v4l2.STAMP_MONOTONIC
        stamp_ns = buffer.seconds * NS_PER_S + buffer.microseconds * 1000
        data = capture.buffers[buffer.index][: buffer.bytesused]
        with _faults(capture.label):
            v4l2.send_request(capture.device, v4l2.QBUF, buffer)
        # The driver returns a frame that it cannot decode as an empty buffer.
        if data and capture.layout is not None:
            data = _encode_raw(data, capture.layout) or b""
            if not data:
                say(f"camera {capture.camera.name}: sends incomplete images; they are not recorded")
        if not data:
            _check_heard(capture, clock.now_ns() - heard_ns)
            yield None
        else:
            missed, last = _missed(last, buffer.sequence), buffer.sequence
            yield Frame(data, "jpeg", clock.to_utc_ns(stamp_ns) if stamped else None, missed)
            heard_ns = clock.now_ns()


def _check_heard(capture: _Capture, silent_ns: int) -> None:
    if silent_ns > _SILENT_S * NS_PER_S:
        raise SourceError(f"{capture.label}: sends no frames; plug it in again, or into another USB port")


def _missed(last: int | None, sequence: int) -> int:
    """Return the number of frames between two 32-bit numbers; 0 if a driver does not count, or restarts."""
    between = 0 if last is None else (sequence - last - 1) & 0xFFFF_FFFF
    return between if between < _COUNTS_ANEW else 0


def _next_buffer(device: int) -> v4l2.Buffer | None:
    """Return the next buffer with a frame; None if no frame arrives in time."""
    select.select([device], [], [], _TURN_S)
    try:
        return v4l2.send_request(device, v4l2.DQBUF, v4l2.Buffer(type=v4l2.VIDEO_CAPTURE, memory=v4l2.MMAP))
    except BlockingIOError:
        return None


def _say_stamps(camera: RigCamera, flags: int, say: Say) -> None:
    """Report the meaning of the driver's stamps if the rig has no meaning, or a different one."""
    head = f"camera {camera.name}: the driver stamps"
    if flags & v4l2.STAMP_CLOCK != v4l2.STAMP_MONOTONIC:
        say(f"{head} with another clock, so its frames get their time of arrival")
        return
    meaning = "start" if flags & v4l2.STAMP_SOURCE == v4l2.STAMP_OF_START else "end"
    if camera.stamp is None:
        say(f'{head} the {meaning} of a frame; write into the rig: stamp = "{meaning}"')
    elif camera.stamp != meaning:
        say(f"{head} the {meaning} of a frame, but the rig has {camera.stamp!r}")


class _ImageLayout(NamedTuple):
    """The layout of an image in memory; ``stride`` is the number of bytes from one row to the next."""

    format: str
    width: int
    height: int
    stride: int

    @property
    def size(self) -> int:
        """The size of an image, in bytes."""
        rows = self.height + self.height // 2 if self.format == "NV12" else self.height
        return self.stride * rows


def _encode_raw(data: bytes, layout: _ImageLayout) -> bytes | None:
    """Encode an image as JPEG, with the grey levels of the camera; return None if data is missing.

    Examples
    --------
    >>> _encode_raw(bytes(64), _ImageLayout("GREY", 8, 8, 8))[:2].hex()
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


def _planes(rows: _Plane, layout: _ImageLayout) -> list[_Plane]:
    """Return the brightness plane and, for colour formats, the two smaller colour planes."""
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
