"""The node: it sends the frames that its recorder has written, and sends again what did not arrive."""

import secrets
import threading
from collections import OrderedDict, deque
from pathlib import Path
from queue import Empty, Full, Queue
from typing import Any, NamedTuple, Self

from ipsys_log.capture.frames import Clock, Say
from ipsys_log.capture.nodes import wire
from ipsys_log.capture.nodes.network import Certificates, NodeNetwork, check_centre, open_node_session
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.growing_channel import GrowingChannel
from ipsys_log.messages import CompressedImage, CompressedVideo, Markers, Message
from ipsys_log.units import NS_PER_S

# Frames that wait to be sent, and the newest frames, which need not be read from the disk.
_MOST_WAITING_BYTES, _MOST_RECENT_BYTES = 32 << 20, 64 << 20
_MOST_REQUESTS = 4
_MOST_FRAMES = 64
_TURN_S = 0.1
# The node of a finished recording waits for a centre that still asks for its session.
_SILENT_NS = 3 * NS_PER_S
# A centre that has another session for this time refuses this node; it accepts a node that was started again
# earlier.
_REFUSED_NS = 10 * NS_PER_S
# The period of the checks whether a centre that does not ask accepts the certificates.
_CHECK_NS = 30 * NS_PER_S
_SESSION_BYTES = 8


class _Recorded(NamedTuple):
    """A recorded frame."""

    number: int
    time_ns: int
    format: str
    data: bytes


class Node:
    """The sender of one camera: a consumer of its recording. A context manager.

    The recorder writes each frame before the node sends it. If the network is too slow, frames are not sent;
    the centre asks for them later.

    Parameters
    ----------
    camera : the name of the camera and of the node.
    network : the address of the centre, and the certificates.
    version : the version of ipsys here.
    log : the log with the frames.
    clock : the clock of the frames.
    say : called with a text about the connection.
    sends_markers : send the markers of each frame instead of the frame.

    Raises
    ------
    IpsysError
        On entering: a certificate is missing or not accepted.
    """

    def __init__(
        self,
        camera: str,
        network: NodeNetwork,
        version: str,
        log: Path,
        clock: Clock,
        say: Say,
        sends_markers: bool = False,
    ) -> None:
        self.session_name = secrets.token_hex(_SESSION_BYTES)
        self._camera, self._network, self._version = camera, network, version
        self._clock, self._say = clock, say
        self._log = log
        self._sent: tuple[type, ...] = (Markers,) if sends_markers else (CompressedImage, CompressedVideo)
        # The channel of the sent messages, after the first one.
        self._channel: GrowingChannel | None = None
        self._session: Any = None
        # The certificates, until the centre has refused them; and the time of the last check.
        self._files: Certificates | None = None
        self._checked_ns = 0
        self._sent_name = "the markers" if sends_markers else "the frames"
        self._count = self._received = 0
        self._has_ended = self._has_other_version = self._is_refused = False
        # The last request of a centre, the last one for this session, and the first one for another session.
        self._asked_ns: int | None = None
        self._accepted_ns: int | None = None
        self._other_ns: int | None = None
        self._changed = threading.Condition()
        self._waiting: deque[_Recorded] = deque()
        self._waiting_bytes = self._recent_bytes = 0
        self._recent: OrderedDict[int, _Recorded] = OrderedDict()
        self._requests: Queue[Any] = Queue(_MOST_REQUESTS)
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=work, name=f"node {camera}", daemon=True)
            for work in (self._send_all, self._answer_all)
        ]

    def __enter__(self) -> Self:
        self._files = self._network.files_of(self._camera)
        reason = None
        if self._files is not None:
            reason = check_centre(self._network.host, self._network.port, self._files)
        self._checked_ns = self._clock.now_ns()
        self._session = open_node_session(self._network, self._camera)
        self._session.declare_queryable(wire.state_key(self._camera), self._answer_state)
        self._session.declare_queryable(wire.missing_key(self._camera), self._enqueue_request)
        for thread in self._threads:
            thread.start()
        if reason is not None:
            self._say(
                f"centre {self._network} does not answer ({reason}); the node records, and sends "
                f"{self._sent_name} to a centre that starts later"
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(_SILENT_NS / NS_PER_S)
        self._session.close()
        if self._channel is not None:
            self._channel.close()

    def __call__(self, message: Message) -> None:
        """Take a recorded message; send it if it is a frame, or its markers."""
        if not isinstance(message.payload, self._sent):
            return
        frame = _recorded(self._count, message.payload)
        with self._changed:
            if self._channel is None:
                self._channel = GrowingChannel(self._log, message.topic)
            self._count += 1
            self._recent[frame.number] = frame
            self._recent_bytes += len(frame.data)
            while self._recent_bytes > _MOST_RECENT_BYTES:
                self._recent_bytes -= len(self._recent.popitem(last=False)[1].data)
            self._waiting.append(frame)
            self._waiting_bytes += len(frame.data)
            while self._waiting_bytes > _MOST_WAITING_BYTES:
                self._waiting_bytes -= len(self._waiting.popleft().data)
            self._changed.notify_all()

    def finish(self, has_ended: bool) -> int:
        """Wait until the centre has all frames, as long as it asks; return the number that it does not have.

        A centre that refuses this node asks, too, but not for its session.

        If the source has not ended (``has_ended``), the node was stopped, and may start again.
        """
        self._has_ended = has_ended
        start_ns = self._clock.now_ns()
        while not self._stopped.wait(_TURN_S):
            now_ns = self._clock.now_ns()
            if (
                self._asked_ns is None
                or now_ns - self._asked_ns > _SILENT_NS
                or now_ns - max(self._accepted_ns or 0, start_ns) > _SILENT_NS
                or self._received >= self._count
            ):
                break
        return self._count - self._received

    def describe_missing(self, count: int, log: Path) -> str:
        """Return a line about the frames, or their markers, that the centre does not have.

        ``log`` is the present path of the log, which may have been renamed.
        """
        missing = f"{count} frames" if self._sent[0] is not Markers else f"the markers of {count} frames"
        return f"the centre {self._network} does not have {missing} of camera {self._camera}; {log} has all"

    def _send_all(self) -> None:
        import zenoh

        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopped.is_set())
                if self._stopped.is_set():
                    return
                frame = self._waiting.popleft()
                self._waiting_bytes -= len(frame.data)
            self._session.put(
                wire.frames_key(self._camera),
                frame.data,
                attachment=self._header(frame),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )

    def _header(self, frame: _Recorded) -> bytes:
        return wire.FrameHeader(self.session_name, frame.number, frame.time_ns, frame.format).encode()

    def _answer_state(self, query: Any) -> None:
        """Answer a request for the state; Zenoh calls this in its thread."""
        received_ns = self._clock.now_ns()
        with query:
            request = wire.decode_text(wire.StateRequest, bytes(query.payload or b""))
            if request is None:
                return
            self._note_centre(request, received_ns)
            state = wire.NodeState(
                self._version,
                self.session_name,
                received_ns,
                self._clock.now_ns(),
                self._count,
                self._has_ended,
            )
            query.reply(wire.state_key(self._camera), wire.encode_text(state), express=True)

    def _note_centre(self, request: wire.StateRequest, now_ns: int) -> None:
        self._asked_ns = now_ns
        if request.session == self.session_name:
            if self._accepted_ns is None:
                self._say(f"the centre {self._network} receives {self._sent_name} of camera {self._camera}")
            self._received, self._accepted_ns, self._other_ns = request.received, now_ns, None
        elif request.session:
            self._note_other(now_ns)
        if request.version != self._version and not self._has_other_version:
            self._has_other_version = True
            self._say(
                f"the centre {self._network} has ipsys {request.version}, but this machine has ipsys "
                f"{self._version}; install one version on both"
            )

    def _note_other(self, now_ns: int) -> None:
        """Note a request for the session of another node; report once that the centre keeps that node."""
        self._other_ns = self._other_ns or now_ns
        if now_ns - self._other_ns > _REFUSED_NS and not self._is_refused:
            self._is_refused = True
            self._say(
                f"the centre {self._network} receives camera {self._camera} from another node, and refuses "
                "this one; end one of them, or give it another --camera"
            )

    def _check_later_centre(self) -> None:
        """Report once if a centre that has started later refuses the certificates, and so never asks."""
        now_ns = self._clock.now_ns()
        if self._files is None or self._asked_ns is not None or now_ns - self._checked_ns < _CHECK_NS:
            return
        self._checked_ns = now_ns
        try:
            check_centre(self._network.host, self._network.port, self._files)
        except IpsysError as error:
            self._files = None
            self._say(f"{error}; the node records on. Start it again with the right files")

    def _enqueue_request(self, query: Any) -> None:
        try:
            self._requests.put_nowait(query)
        except Full:
            query.drop()

    def _answer_all(self) -> None:
        """Answer requests for missing frames, one after the other."""
        while not self._stopped.is_set():
            try:
                query = self._requests.get(timeout=_TURN_S)
            except Empty:
                self._check_later_centre()
                continue
            with query:
                request = wire.decode_text(wire.FrameRequest, bytes(query.payload or b""))
                if request is not None and request.session == self.session_name:
                    self._answer_frames(query, request)

    def _answer_frames(self, query: Any, request: wire.FrameRequest) -> None:
        for number in range(request.first, min(request.end, request.first + _MOST_FRAMES)):
            if number >= self._count or self._stopped.is_set():
                return
            frame = self._find(number) or _Recorded(number, 0, "jpeg", b"")
            query.reply(wire.missing_key(self._camera), frame.data, attachment=self._header(frame))

    def _find(self, number: int) -> _Recorded | None:
        """Return a recorded frame, from memory or from the log; None if the log does not hold it."""
        with self._changed:
            frame = self._recent.get(number)
        if frame is not None:
            return frame
        try:
            payload = None if self._channel is None else self._channel.read(number)
        except (IpsysError, OSError):
            return None
        return None if payload is None else _recorded(number, payload)


def _recorded(number: int, payload: Any) -> _Recorded:
    if isinstance(payload, Markers):
        return _Recorded(number, payload.timestamp, wire.MARKERS_FORMAT, encode(payload))
    return _Recorded(number, payload.timestamp, payload.format, payload.data)
