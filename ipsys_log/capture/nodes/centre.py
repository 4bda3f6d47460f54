"""The centre: the sources ``zenoh:NODE``, whose frames nodes send over Zenoh.

All cameras of a recording share one session. The centre asks each node for its state ten times a second, and
more often in the first 30 s if there are few nodes. It asks for frames that did not arrive with the lowest
priority. All arrivals wait in a queue with a limit; a dropped frame is missing, so the node sends it again.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, Self

from ipsys_log.capture.frames import Clock, Frame, Say, SourceError, SourceMessage
from ipsys_log.capture.nodes import wire
from ipsys_log.capture.nodes.network import AUTHORITY, NodeNetwork, open_centre_session
from ipsys_log.capture.nodes.stream import NodeStream
from ipsys_log.messages import RigCamera
from ipsys_log.messages.rig_file import check_name
from ipsys_log.units import NS_PER_S

_SCHEME = "zenoh:"
_MOST_WAITING_BYTES = 64 << 20
# The period of the exchanges up to a number of them: the first ones together find offset and drift.
_FIRST_EXCHANGES = 500
_TURNS_S = ((_FIRST_EXCHANGES, 0.02), (1000, 0.04))
_TURN_S = 0.1
# After the first ones, many nodes share this number: exchanges need the time of the receiving process.
_MOST_EXCHANGES_PER_S = 480
_FIRST_ANSWER_S, _WAIT_UNSAID_S, _OPENING_EXCHANGES = 60.0, 3.0, 10
_SILENT_NS = 5 * NS_PER_S
_ANSWER_S, _FRAMES_S = 3.0, 20.0


def exchange_period_s(exchanges: int, nodes: int = 1) -> float:
    """Return the period of the exchanges of times with a node after a number of them, in s.

    Parameters
    ----------
    nodes : all nodes of the centre; with many nodes, the period is longer after the first exchanges.

    Examples
    --------
    >>> exchange_period_s(0), exchange_period_s(0, nodes=24)
    (0.02, 0.02)
    >>> exchange_period_s(600), exchange_period_s(600, nodes=24)
    (0.04, 0.05)
    >>> exchange_period_s(100_000)
    0.1
    """
    period_s = next((period_s for count, period_s in _TURNS_S if exchanges < count), _TURN_S)
    if exchanges < _FIRST_EXCHANGES:
        return period_s
    return min(max(period_s, nodes / _MOST_EXCHANGES_PER_S), _TURN_S)


def is_of_node(camera: RigCamera) -> bool:
    """Return whether a node sends the frames of a camera."""
    return str(camera.source).startswith(_SCHEME)


def node_of(camera: RigCamera) -> str:
    """Return the name of the node of a camera.

    Examples
    --------
    >>> node_of(RigCamera("red", source="zenoh:red"))
    'red'
    """
    return check_name(str(camera.source).removeprefix(_SCHEME), f"camera {camera.name}: the node")


def describe_no_answer(camera: RigCamera, network: NodeNetwork) -> str:
    """Return the text of the error that no node answers for a camera."""
    node = node_of(camera)
    text = (
        f"camera {camera.name}: no node {node} answers at {network}; start it on its host: "
        f"ipsys node lab.toml --camera {node}"
    )
    if network.certificates is None:
        return text
    # Without a connection, the centre cannot see the certificate of the node.
    return f"{text}. If it runs there, {_describe_authority(network.certificates)}"


def _describe_silence(camera: RigCamera, network: NodeNetwork) -> str:
    """Return the text of the error that the node of a camera does not answer any more."""
    text = f"camera {camera.name}: its node does not answer; check that it runs, and its network"
    if network.certificates is None:
        return text
    return f"{text}. If it was started again, {_describe_authority(network.certificates)}"


def _describe_authority(folder: Path) -> str:
    authority = folder / AUTHORITY
    return f"check that the {AUTHORITY} of its host is the same file as {authority}; docs/nodes.md has more"


class _Arrival(NamedTuple):
    """Something from a node: its time, its bytes, and the function of the stream that takes it."""

    size: int
    take: Callable[[], Iterator[Frame | SourceMessage]]


class Centre:
    """The session that receives the frames of nodes. A context manager.

    Parameters
    ----------
    cameras : cameras whose source is a node.
    network : the address and the certificates.
    version : the version of ipsys here; a node with another version is refused.

    Raises
    ------
    IpsysError
        The centre cannot listen.
    """

    def __init__(self, cameras: Sequence[RigCamera], network: NodeNetwork, version: str) -> None:
        self._nodes = {camera.name: node_of(camera) for camera in cameras}
        self._network, self._version = network, version
        self._session: Any = open_centre_session(network, list(self._nodes.values()))
        self._links: dict[str, _Link] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()

    @contextmanager
    def open(
        self, camera: RigCamera, clock: Clock, say: Say
    ) -> Iterator[Iterator[Frame | SourceMessage | None]]:
        """Open the camera of a node; an :data:`~ipsys_log.capture.frames.Open`.

        The iterator never waits: it yields None if nothing has arrived.

        Raises
        ------
        SourceError
            In the iteration: no node answers, the node has another version, or two nodes have the name.
        """
        link = self._links.get(camera.name)
        if link is None:
            stream = NodeStream(camera, self._version)
            period_s = partial(exchange_period_s, nodes=len(self._nodes))
            link = _Link(self._session, camera, self._nodes[camera.name], stream, clock, period_s)
            self._links[camera.name] = link
        yield chain(link.await_node(self._network, say), link.items(self._network))


def _directly(receive: Callable[[Any], None]) -> Any:
    """Return a handler that is called in the thread of the network.

    Otherwise, the library starts a thread of Python for each request: 240 a second for 24 nodes.
    """
    import zenoh

    return zenoh.handlers.Callback(receive, indirect=False)


class _Link:
    """The connection to one node: its subscription, its requests, and the queue of arrivals."""

    def __init__(
        self,
        session: Any,
        camera: RigCamera,
        node: str,
        stream: NodeStream,
        clock: Clock,
        period_s: Callable[[int], float],
    ) -> None:
        self.heard_ns = clock.now_ns()
        self._session, self._camera, self._node, self._period_s = session, camera, node, period_s
        self._stream, self._clock = stream, clock
        self._lock = threading.Lock()
        self._waiting: deque[_Arrival] = deque()
        self._waiting_bytes = 0
        # The number of answers, and items from before the opening.
        self._exchanges = 0
        self._early: list[Frame | SourceMessage] = []
        self._state_asked_ns = 0
        self._asks_frames = False
        self._subscriber = session.declare_subscriber(wire.frames_key(node), _directly(self._receive))

    def await_node(self, network: NodeNetwork, say: Say) -> Iterator[None]:
        """Yield None until the node has answered; ``say`` reports a longer wait."""
        start_ns = self.heard_ns = self._clock.now_ns()
        is_said, is_first = False, not self._stream.is_known
        while not (self._exchanges >= _OPENING_EXCHANGES and self._stream.is_known):
            waited_s = (self._clock.now_ns() - start_ns) / NS_PER_S
            if waited_s > _FIRST_ANSWER_S:
                break
            if waited_s > _WAIT_UNSAID_S and not is_said and not self._exchanges:
                is_said = True
                say(f"camera {self._camera.name}: waits for node {self._node} at {network}")
            arrival = self._take()
            self._ask_state()
            if arrival is None:
                yield None
            else:
                self._early += arrival.take()
        if not self._stream.is_known:
            raise SourceError(describe_no_answer(self._camera, network))
        if is_first:
            self._early.insert(0, self._stream.report_answer(self._clock.now_ns()))

    def items(self, network: NodeNetwork) -> Iterator[Frame | SourceMessage | None]:
        """Yield the frames and the messages about them.

        Raises
        ------
        SourceError
            The node does not answer any more, or it is refused.
        """
        yield from self._early
        self._early.clear()
        while True:
            self._ask_state()
            self._ask_frames()
            arrival = self._take()
            if arrival is None:
                if self._clock.now_ns() - self.heard_ns > _SILENT_NS:
                    raise SourceError(_describe_silence(self._camera, network))
                yield None
                continue
            yield from arrival.take()
            if self._stream.has_ended:
                return

    def _take(self) -> _Arrival | None:
        if not self._waiting:
            return None
        with self._lock:
            arrival = self._waiting.popleft()
            self._waiting_bytes -= arrival.size
            return arrival

    def _put(self, size: int, take: Callable[[], Iterator[Frame | SourceMessage]]) -> None:
        with self._lock:
            self.heard_ns = self._clock.now_ns()
            if size and self._waiting_bytes + size > _MOST_WAITING_BYTES:
                return
            self._waiting_bytes += size
            self._waiting.append(_Arrival(size, take))

    def _receive(self, sample: Any, is_late: bool = False) -> None:
        """Take a frame; Zenoh calls this in its thread."""
        now_ns = self._clock.now_ns()
        header = (
            wire.FrameHeader.decode(sample.attachment.to_bytes()) if sample.attachment is not None else None
        )
        if header is None:
            return
        data = sample.payload.to_bytes()
        if data:
            self._put(len(data), partial(self._stream.take_frame, header, data, now_ns, is_late))
        elif is_late:
            self._put(1, partial(self._stream.lose, header, now_ns))

    def _ask_state(self) -> None:
        """Ask the node for its state, if the last request is old enough."""
        import zenoh

        since_s = (self._clock.now_ns() - self._state_asked_ns) / NS_PER_S
        if since_s < self._period_s(self._exchanges):
            return
        self._state_asked_ns = sent_ns = self._clock.now_ns()

        def receive(reply: Any) -> None:
            back_ns = self._clock.now_ns()
            state = (
                wire.decode_text(wire.NodeState, reply.ok.payload.to_bytes())
                if reply.ok is not None
                else None
            )
            if state is not None:
                self._exchanges += 1
                self._put(0, partial(self._stream.take_state, state, sent_ns, back_ns))

        self._session.get(
            wire.state_key(self._node),
            _directly(receive),
            payload=wire.encode_text(self._stream.state_request()),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
            timeout=_ANSWER_S,
        )

    def _ask_frames(self) -> None:
        """Ask the node for missing frames, unless a request is under way."""
        import zenoh

        request = self._stream.frame_request()
        if request is None or self._asks_frames or self._waiting_bytes > _MOST_WAITING_BYTES // 2:
            return
        self._asks_frames = True
        self._session.get(
            wire.missing_key(self._node),
            zenoh.handlers.Callback(self._receive_late, self._end_late),
            payload=wire.encode_text(request),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.BACKGROUND,
            timeout=_FRAMES_S,
        )

    def _receive_late(self, reply: Any) -> None:
        if reply.ok is not None:
            self._receive(reply.ok, is_late=True)

    def _end_late(self) -> None:
        """Allow the next request as soon as the stream has taken all frames of this one."""

        def finish() -> Iterator[Frame | SourceMessage]:
            self._asks_frames = False
            return iter(())

        self._put(0, finish)
