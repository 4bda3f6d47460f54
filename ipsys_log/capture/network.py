"""Cameras on the network: RTSP, MJPEG over HTTP, and every address that FFmpeg opens.

The packets are never decoded. They are JPEG images, or H.264 and H.265 as Annex B. The parameter sets come
before each keyframe, as ``foxglove.CompressedVideo`` requires.
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

from ipsys_log.capture.frames import (
    AccessRefusedError,
    ActualSettings,
    Clock,
    Frame,
    Say,
    SourceError,
    report_refused_settings,
)
from ipsys_log.capture.video_files import find_video, name_format, pass_through
from ipsys_log.extras import check_installed
from ipsys_log.messages import RigCamera
from ipsys_log.plain_text import hide_password
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

# Largest and smallest age of a frame by its stamp. Beyond them, the clock of the camera is not synchronized.
_OLDEST_NS = NS_PER_S
_YOUNGEST_NS = -NS_PER_S // 20


class Stamps:
    """The stamps of one stream, with a check of the camera's clock; the result is reported once.

    Parameters
    ----------
    name : name of the camera.
    clock : clock of the recorder.
    say : called with the kind of stamps that the frames get.
    patience : most frames that may arrive before the first stamp. An RTSP sender relates its stamps to its
        clock by reports, and sends one report every few seconds.
    """

    def __init__(self, name: str, clock: Clock, say: Say, patience: int = 1) -> None:
        self._name = name
        self._clock = clock
        self._say = say
        self._patience = patience
        self._stamped = False
        self._trusted: bool | None = None

    def of(self, packet: Packet[VideoStream]) -> int | None:
        """Return the capture time of a packet's frame, in ns of UTC; None if it is not known."""
        time_ns, stamped, self._stamped = read_stamp(packet), self._stamped, packet.has_sidedata("prft")
        if not stamped:
            # FFmpeg copies the first stamp to the frame before it, so the stamp of that frame is wrong.
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
        age = (
            f"{abs(age_ns) / NS_PER_S:.3f} s {'behind' if age_ns >= 0 else 'ahead of'} the clock of "
            "this machine"
        )
        if self._trusted:
            self._say(
                f"camera {self._name}: its frames have the stamps of the camera (RTCP), {age}; sync it by NTP"
            )
        else:
            self._say(f"camera {self._name}: its clock is {age}, so its stamps are not used; sync it by NTP")


def read_stamp(packet: Packet[VideoStream]) -> int | None:
    """Return the sender's wall clock for a packet, in ns since 1970; an RTSP sender sends it by RTCP."""
    if not packet.has_sidedata("prft"):
        return None
    # AVProducerReferenceTime: int64 of microseconds, int of flags.
    wall_us: int = struct.unpack_from("=q", bytes(packet.get_sidedata("prft")))[0]
    return wall_us * 1000


# A stream that sends nothing for this time is disconnected.
_SILENT_S = 5.0
_TURN_S = 0.4
# Most frames in the queue between FFmpeg's thread and ours; later frames wait in the socket.
_WAITING = 4
# Most frames before the first stamp. RTSP's first report of the camera's clock arrives within about 5 s:
# after 150 frames at 30 frames/s.
_PATIENCE = 300
_OPTIONS = {
    "rtsp_flags": "prefer_tcp",
    # With a buffer, the packets read to detect the type of the stream would arrive late, and all at once.
    "fflags": "nobuffer",
    "analyzeduration": "1000000",
}

# The protocols of FFmpeg that a stream may use, by the scheme of its address. A playlist names further
# addresses: without this limit, a camera can name files of this machine (file://), and the setup page shows
# them.
_WEB = "http,https,httpproxy,crypto,tcp,tls"
_PROTOCOLS = {
    "http": _WEB,
    "https": _WEB,
    "rtsp": "rtp,tcp,udp",
    "rtsps": "rtp,srtp,tcp,tls,udp",
    "tcp": "tcp",
    "udp": "udp",
}

# The queue holds frames, then the error, or None at the end of the stream.
_Queue = Queue[Frame | SourceError | None]


@contextmanager
def open_network(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """Open a stream; an :data:`~ipsys_log.capture.frames.Open`.

    A read of FFmpeg cannot be interrupted, so a separate thread reads. On leaving, the caller does not
    wait for this thread. It ends after its current read, within 5 s. The thread opens the address too, so
    the iterator raises the :class:`~ipsys_log.capture.frames.SourceError`.

    Parameters
    ----------
    camera : its ``source`` is the address.
    clock : clock of the recorder; the camera's own clock is compared with it.
    say : called with each setting that the stream does not give.
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
        last = SourceError(f"camera {camera.name}: internal error while reading ({error!r})")
        raise
    finally:
        _put(queue, last, stop)


def _put(queue: _Queue, item: Frame | SourceError | None, stop: Event) -> bool:
    """Put an item into the queue; return False if the reader has stopped."""
    while not stop.is_set():
        try:
            queue.put(item, timeout=_TURN_S)
        except Full:
            continue
        return True
    return False


def _frames(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Frame]:
    """Yield frames until the camera is disconnected; :func:`_read` calls it in its thread."""
    import av

    label = f"camera {camera.name}: {hide_password(camera.source or '')}"
    try:
        with _open(camera.source or "", label) as container:
            stream = find_video(container, label)
            codec = stream.codec_context
            name = name_format(stream)
            if name is None:
                raise SourceError(f"{label}: is {codec.name} video; set the camera to MJPEG, H.264 or H.265")
            rate_hz = float(stream.average_rate) if stream.average_rate else None
            report_refused_settings(camera, ActualSettings(codec.width, codec.height, rate_hz), say)
            stamps = Stamps(camera.name, clock, say, _PATIENCE if container.format.name == "rtsp" else 1)
            # A stream that stops within a packet has ended. This is no error of the data.
            with suppress(av.error.InvalidDataError):
                for packet in pass_through(_heard(container.demux(stream), clock, label), stream):
                    yield Frame(bytes(packet), name, stamps.of(packet))
            # The stream of a connected camera does not end. After an error, the camera is opened again.
            raise SourceError(f"{label}: the stream has ended")
    except (av.error.HTTPUnauthorizedError, av.error.HTTPForbiddenError) as error:
        raise AccessRefusedError(f"{label}: {_explain(error)}") from error
    except av.error.FFmpegError as error:
        raise SourceError(f"{label}: {_explain(error)}") from error


def _heard(packets: Iterable[Packet[VideoStream]], clock: Clock, label: str) -> Iterator[Packet[VideoStream]]:
    """Yield packets; raise an error after a long time with only empty packets."""
    heard_ns = clock.now_ns()
    for packet in packets:
        if not packet.size and clock.now_ns() - heard_ns > _SILENT_S * NS_PER_S:
            raise SourceError(f"{label}: sends only empty frames; restart the camera")
        yield packet
        if packet.size:
            heard_ns = clock.now_ns()


def _open(address: str, label: str) -> InputContainer:
    import av

    host = urlsplit(address).hostname
    try:
        if host is not None:  # udp://:5000 is sent to this machine
            socket.getaddrinfo(host, None)
    except (socket.gaierror, UnicodeError) as error:  # UnicodeError: a part of the name is empty or too long
        if isinstance(error, UnicodeError) or error.errno == socket.EAI_NONAME:
            raise SourceError(f"{label}: the host {host!r} does not exist; check the address") from error
        raise SourceError(
            f"{label}: the name {host!r} cannot be resolved ({error.strerror}); check the network, "
            "or use the IP address"
        ) from error
    options = {**_OPTIONS, "protocol_whitelist": _PROTOCOLS[address.partition(":")[0].lower()]}
    return av.open(address, options=options, timeout=_SILENT_S)


def _explain(error: Exception) -> str:
    """Describe an error of FFmpeg for the user, and the remedy."""
    import av

    explanations = {
        av.error.ConnectionRefusedError: "refuses the connection; check that the camera is on, and the port",
        av.error.HTTPNotFoundError: "the camera has no such path; find the path in the camera's manual",
        av.error.HTTPUnauthorizedError: "the password is missing or not accepted; put user:password@ before "
        "the host",
        av.error.HTTPForbiddenError: "the user may not see the stream; give the user this right in the "
        "camera",
        av.error.InvalidDataError: "is not video; give the address of the stream, not of a web page",
        av.error.ExitError: f"no data for {_SILENT_S:g} s; check the camera and the network",
        av.error.TimeoutError: "does not answer; check the camera and the network",
        av.error.ProtocolNotFoundError: "has a protocol that FFmpeg does not support; use rtsp:// or http://",
    }
    for kind, text in explanations.items():
        if isinstance(error, kind):
            return text
    return f"cannot be read ({getattr(error, 'strerror', None) or error}); test the address in another player"


def check_address(camera: RigCamera) -> None:
    """Check that the source of a camera is a valid address, and that the library for it is installed.

    Raises
    ------
    IpsysError
        The library is missing, or the address names no host. A stream that is sent to this machine
        (``udp://:5000``) needs no host.
    """
    address = camera.source or ""
    check_installed(f"camera {camera.name}: the source {hide_password(address)} needs", "av")
    if not address.lower().startswith(("http", "rtsp")):
        return
    try:
        host = urlsplit(address).hostname
    except ValueError:
        host = None
    if host is None:
        raise SourceError(
            f"camera {camera.name}: {hide_password(address)!r} has no host; write it as "
            "http://192.168.1.20:8080/video or rtsp://user:password@192.168.1.20/stream"
        )
