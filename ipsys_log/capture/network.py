"""Cameras on the network: RTSP, MJPEG over HTTP, and every address that FFmpeg opens.

Packets are handed on as they came, never decoded: JPEG pictures, or H.264 and H.265 as Annex B with the
parameter sets before each keyframe, which is what ``foxglove.CompressedVideo`` asks for.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from ipsys_log.capture.frames import Clock, Frame, Given, Say, SourceError, say_refused
from ipsys_log.capture.video_packets import find_video, name_format, pass_through
from ipsys_log.messages import RigCamera
from ipsys_log.rig.file import hide_password
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

__all__ = ["Stamps", "check_address", "open_network", "read_stamp"]

# A frame that is said to be older, or younger, comes from a camera whose clock is not ours.
_OLDEST_NS = NS_PER_S
_YOUNGEST_NS = -NS_PER_S // 20


class Stamps:
    """Stamps of one stream, as far as they are to be trusted, and what is to be said of that, once.

    Parameters
    ----------
    name : of the camera.
    clock : ours.
    say : told how the frames are stamped.
    patience : so many frames may come before the first stamp. RTSP's sender ties its stamps to a clock by
        reports, one every few seconds.
    """

    def __init__(self, name: str, clock: Clock, say: Say, patience: int = 1) -> None:
        self._name = name
        self._clock = clock
        self._say = say
        self._patience = patience
        self._stamped = False
        self._trusted: bool | None = None

    def of(self, packet: Packet[VideoStream]) -> int | None:
        """When a packet's frame was taken, in ns of UTC; None where that is not known."""
        time_ns, stamped, self._stamped = read_stamp(packet), self._stamped, packet.has_sidedata("prft")
        if not stamped:
            # FFmpeg gives the frame before the first that has a stamp that one's.
            time_ns = None
        if self._trusted is None:
            self._judge(time_ns)
        return time_ns if self._trusted else None

    def _judge(self, time_ns: int | None) -> None:
        if time_ns is None:
            self._patience -= 1
            if not self._patience:
                self._trusted = False
                self._say(
                    f"camera {self._name}: sends no capture stamps; its frames get their time of arrival"
                )
            return
        age_ns = self._clock.now_ns() - time_ns
        self._trusted = _YOUNGEST_NS <= age_ns <= _OLDEST_NS
        age = f"{abs(age_ns) / NS_PER_S:.3f} s {'behind' if age_ns >= 0 else 'ahead of'} ours"
        if self._trusted:
            self._say(
                f"camera {self._name}: frames have the camera's own stamps (RTCP), {age}; sync it by NTP"
            )
        else:
            self._say(f"camera {self._name}: its clock is {age}, so its stamps are not used; sync it by NTP")


def read_stamp(packet: Packet[VideoStream]) -> int | None:
    """The wall clock of the sender that goes with a packet, in ns since 1970; RTSP's comes by RTCP."""
    if not packet.has_sidedata("prft"):
        return None
    # AVProducerReferenceTime: int64 of microseconds, int of flags.
    wall_us: int = struct.unpack_from("=q", bytes(packet.get_sidedata("prft")))[0]
    return wall_us * 1000


# A stream that is silent for so long has gone.
_SILENT_S = 5.0
_TURN_S = 0.4
# Frames between FFmpeg's thread and ours; what is behind them waits in the socket.
_WAITING = 4
# RTSP's first report of the camera's clock comes within 5 s or so: at 30 frames/s, in time.
_PATIENCE = 300
_OPTIONS = {
    "rtsp_flags": "prefer_tcp",
    # What was read to find out what the stream is would come late, and in one go.
    "fflags": "nobuffer",
    "analyzeduration": "1000000",
}

# Frames, what went wrong, or None at the end of the stream.
_Queue = Queue[Frame | SourceError | None]


@contextmanager
def open_network(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """The frames of a stream, as :data:`~ipsys_log.capture.frames.Open` says.

    A read of FFmpeg's cannot be broken off, so a thread of its own reads; on leaving it is left to
    itself, and ends with what it waits for, after 5 s at the latest. The address is opened there too:
    a :class:`~ipsys_log.capture.frames.SourceError` comes from the iterator.

    Parameters
    ----------
    camera : its ``source`` is the address.
    clock : to tell by how much the camera's own clock is off.
    say : told what the stream does not give.
    """
    queue: _Queue = Queue(_WAITING)
    stop = Event()
    reader = Thread(target=_read, args=(camera, clock, say, queue, stop), name=camera.name, daemon=True)
    reader.start()
    try:
        yield _take(queue)
    finally:
        stop.set()


def _take(queue: _Queue) -> Iterator[Frame | None]:
    while True:
        try:
            item = queue.get(timeout=_TURN_S)
        except Empty:
            yield None
            continue
        if item is None:
            return
        if isinstance(item, SourceError):
            raise item
        yield item


def _read(camera: RigCamera, clock: Clock, say: Say, queue: _Queue, stop: Event) -> None:
    last: SourceError | None = None
    try:
        for frame in _frames(camera, clock, say):
            if not _put(queue, frame, stop):
                return
    except SourceError as error:
        last = error
    except Exception as error:
        last = SourceError(f"camera {camera.name}: the program failed while it read ({error!r})")
        raise
    finally:
        _put(queue, last, stop)


def _put(queue: _Queue, item: Frame | SourceError | None, stop: Event) -> bool:
    """Return whether it was wanted."""
    while not stop.is_set():
        try:
            queue.put(item, timeout=_TURN_S)
        except Full:
            continue
        return True
    return False


def _frames(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Frame]:
    """Frames until the camera has gone, from :func:`_read`'s thread."""
    import av

    where = f"camera {camera.name}: {hide_password(camera.source or '')}"
    try:
        with _open(camera.source or "", where) as container:
            stream = find_video(container, where)
            codec = stream.codec_context
            name = name_format(stream)
            if name is None:
                raise SourceError(f"{where}: is {codec.name} video; set the camera to MJPEG, H.264 or H.265")
            rate_hz = float(stream.average_rate) if stream.average_rate else None
            say_refused(camera, Given(codec.width, codec.height, rate_hz), say)
            stamps = Stamps(camera.name, clock, say, _PATIENCE if container.format.name == "rtsp" else 1)
            # A stream that stops within a packet has ended.
            with suppress(av.error.InvalidDataError):
                for packet in pass_through(_heard(container.demux(stream), clock, where), stream):
                    yield Frame(bytes(packet), name, stamps.of(packet))
            # A camera that is there does not end: it may come back.
            raise SourceError(f"{where}: the stream has ended")
    except av.error.FFmpegError as error:
        raise SourceError(f"{where}: {_explain(error)}") from error


def _heard(packets: Iterable[Packet[VideoStream]], clock: Clock, where: str) -> Iterator[Packet[VideoStream]]:
    """Packets, until for long only empty ones have come, which is as silent as none."""
    heard_ns = clock.now_ns()
    for packet in packets:
        if not packet.size and clock.now_ns() - heard_ns > _SILENT_S * NS_PER_S:
            raise SourceError(f"{where}: sends only empty frames; start the camera anew")
        yield packet
        if packet.size:
            heard_ns = clock.now_ns()


def _open(address: str, where: str) -> InputContainer:
    import av

    host = urlsplit(address).hostname
    try:
        socket.getaddrinfo(host, None)
    except socket.gaierror as error:
        if error.errno == socket.EAI_NONAME:
            raise SourceError(f"{where}: there is no host {host!r}; check the address") from error
        raise SourceError(
            f"{where}: the name {host!r} cannot be looked up ({error.strerror}); check the network, "
            "or write the address as a number"
        ) from error
    return av.open(address, options=dict(_OPTIONS), timeout=_SILENT_S)


def _explain(error: Exception) -> str:
    """What an error of FFmpeg's means for the user, and what to do."""
    import av

    known = {
        av.error.ConnectionRefusedError: "refuses the connection; is the camera on, and the port right?",
        av.error.HTTPNotFoundError: "the camera has no such path; look it up in the camera's manual",
        av.error.HTTPUnauthorizedError: "asks for a password, or another; put user:password@ before the host",
        av.error.HTTPForbiddenError: "the camera forbids it; give the user the right to see the stream",
        av.error.InvalidDataError: "is not video; give the address of the stream, not of a web page",
        av.error.ExitError: f"nothing came for {_SILENT_S:g} s; is the camera on, and the network up?",
        av.error.TimeoutError: "does not answer; is the camera on, and the network up?",
        av.error.ProtocolNotFoundError: "is of a protocol that FFmpeg does not know; use rtsp:// or http://",
    }
    for kind, text in known.items():
        if isinstance(error, kind):
            return text
    return f"cannot be read ({getattr(error, 'strerror', None) or error}); try the address in another player"


def check_address(camera: RigCamera) -> None:
    """See that the source of a camera is an address.

    Raises
    ------
    SourceError
        Where it names no host. A stream that is sent to this machine (``udp://:5000``) needs none.
    """
    address = camera.source or ""
    if not address.lower().startswith(("http", "rtsp")):
        return
    try:
        host = urlsplit(address).hostname
    except ValueError:
        host = None
    if host is None:
        raise SourceError(
            f"camera {camera.name}: {hide_password(address)!r} names no host; write it as "
            "http://192.168.1.20:8080/video or rtsp://user:password@192.168.1.20/stream"
        )
