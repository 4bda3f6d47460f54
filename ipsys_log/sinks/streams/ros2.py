"""ROS 2 stream: poses as transforms, poses with covariance and odometry, over Zenoh and without ROS."""

import socket
import threading
from collections.abc import Iterator, Mapping
from typing import Any

import zenoh

from ipsys_log.capture.frames import Clock
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message, Tracks
from ipsys_log.sinks.sink import DropReport
from ipsys_log.sinks.streams import ros2_messages as ros2
from ipsys_log.sinks.streams.addresses import LOOPBACK, is_loopback, listen
from ipsys_log.sinks.streams.poses import NewSession, StreamContext, StreamPose
from ipsys_log.sinks.streams.rmw_zenoh import Entity, Publisher, Qos, configure
from ipsys_log.sinks.streams.ros2_messages import is_stampable, type_hash

_NODE = "ipsys"
_MOST_DOMAIN = 232
_MOST_ROBOTS = 256
_CONNECT_S, _QUERY_S = 0.5, 1.0
# A node that has just ended may still be known to the router.
_QUERIES, _PAUSE_S = 3, 0.3
_TICK_S, _TICKS_PER_DIAGNOSIS = 0.05, 20


class Ros2Stream:
    """A :class:`~ipsys_log.sinks.sink.InlineSink` that publishes poses to nodes of ROS 2 with ``rmw_zenoh``.

    If a Zenoh router answers on the port, the stream is its client. Else the stream is the router. Stale
    poses, poses outside the calibrated volume and poses without heading are withheld.

    Parameters
    ----------
    port : the port of the router, usually 7447.
    context : the inputs of all streams; the times of a recording are sent as ``/clock``.

    Raises
    ------
    IpsysError
        The port is in use by another program, or another ipsys sends to this router.
    """

    payloads: tuple[type, ...] = (Tracks, NewSession)

    def __init__(self, port: int, context: StreamContext) -> None:
        domain, host = context.settings.ros2_domain, context.settings.host
        if not 0 <= domain <= _MOST_DOMAIN:
            raise IpsysError(f"--ros2-domain {domain}: give a domain ID from 0 to {_MOST_DOMAIN}")
        self.port, self._host, self._domain = port, host or LOOPBACK, domain
        self.name = f"ROS 2 domain {domain}"
        self._poses, self._now_ns, self._clock = context.poses(), context.now_ns, Clock()
        self.drops = DropReport(self.name, context.warn)
        heights_m = context.streamed_heights_m
        self._newest: dict[str, StreamPose | None] = dict.fromkeys(heights_m)
        self._is_replayed = context.is_replayed
        self._ended = threading.Event()
        self.is_router = not _answers(port)
        self._session = _open_session(domain, port, host, self.is_router)
        try:
            self._announce({name: m for name, m in heights_m.items() if m is not None})
        except BaseException:
            self._close_session()
            raise
        self._thread = threading.Thread(target=self._tick, name=self.name, daemon=True)
        self._thread.start()

    def describe(self) -> str:
        """Return one line about the receivers of the positions."""
        if not self.is_router:
            return f"{self.name}: every node that reaches the router on port {self.port}"
        name = f"{self.name}, as the router on port {self.port}"
        if is_loopback(self._host):
            return f"{name}: only this machine"
        return f"{name}: every computer that reaches {self._host} can read the positions"

    def close(self) -> None:
        """Close the session: a program that ends without this can hang."""
        self.drops.finish()
        self._ended.set()
        self._thread.join()
        self._close_session()

    def _close_session(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def _announce(self, heights_m: Mapping[str, float]) -> None:
        """Declare the node and its publishers."""
        self._entity = Entity(self._domain, str(self._session.info.zid()), _NODE)
        self._token = self._session.liveliness().declare_token(self._entity.node_token())
        self._publishers: dict[str, Publisher] = {}
        self._declare("/tf", ros2.TF, Qos(100))
        self._declare("/diagnostics", ros2.DIAGNOSTICS)
        if self._is_replayed:
            self._declare("/clock", ros2.CLOCK, Qos(1, is_reliable=False))
        for robot in self._newest:
            self._declare(f"/{robot}/pose", ros2.POSE)
            self._declare(f"/{robot}/odom", ros2.ODOMETRY)
        if heights_m:
            self._declare("/tf_static", ros2.TF, Qos(1, is_latched=True))
            self._put("/tf_static", ros2.TF, ros2.encode_static(heights_m, self._now_ns()))

    def _declare(self, topic: str, ros_type: str, qos: Qos | None = None) -> None:
        number = len(self._publishers) + 1
        self._publishers[topic] = Publisher(
            self._session, self._entity, number, topic, ros_type, type_hash(ros_type), qos or Qos()
        )

    def send(self, message: Message) -> None:
        """Publish the poses of a message."""
        poses = list(self._poses.read(message))
        self._send_clock()
        for pose in poses:
            if pose.track.robot in self._newest or len(self._newest) < _MOST_ROBOTS:
                self._newest[pose.track.robot] = pose
        for topic, ros_type, data in ros2.encode_poses(ros2.sendable(poses)):
            self._put(topic, ros_type, data)

    def _put(self, topic: str, ros_type: str, data: bytes) -> None:
        if topic not in self._publishers:
            self._declare(topic, ros_type)
        try:
            self._publishers[topic].put(data, self._clock.now_ns())
        except zenoh.ZError as error:
            self.drops.add(str(error))

    def _send_clock(self) -> None:
        now_ns = self._now_ns()
        if self._is_replayed and is_stampable(now_ns):
            self._put("/clock", ros2.CLOCK, ros2.encode_clock(now_ns))

    def _tick(self) -> None:
        """Send the clock of a replay between the positions, and once a second the diagnostics."""
        number = 0
        while not self._ended.wait(_TICK_S):
            self._send_clock()
            number = (number + 1) % _TICKS_PER_DIAGNOSIS
            now_ns = self._now_ns()
            if number == 0 and is_stampable(now_ns):
                newest = dict(self._newest)
                poses = self._poses
                text = ros2.encode_diagnostics(newest, poses.session, now_ns, poses.stale_s, poses.state)
                self._put("/diagnostics", ros2.DIAGNOSTICS, text)


def _answers(port: int) -> bool:
    """Return whether a program listens on a port of this machine."""
    try:
        socket.create_connection((LOOPBACK, port), _CONNECT_S).close()
    except OSError:
        return False
    return True


def _open_session(domain: int, port: int, host: str | None, is_router: bool) -> zenoh.Session:
    """Open the session, as the router or as a client of the router on the port."""
    if is_router:
        # The errors of Zenoh name no reason.
        listen(host or LOOPBACK, port, "--ros2", 1).close()
    try:
        session = zenoh.open(configure(domain, port, host, is_router))
    except zenoh.ZError as error:
        raise IpsysError(
            f"--ros2: port {port} is in use by a program that is not a Zenoh router; end that program, or "
            "give another port"
        ) from error
    if not is_router and _has_other(session):
        session.close()  # type: ignore[no-untyped-call]
        raise IpsysError(f"--ros2: another ipsys is on port {port} already; end it, or give another port")
    return session


def _has_other(session: zenoh.Session) -> bool:
    """Return whether the router knows a node of another ipsys; that router passes no messages of ours."""
    for number in range(_QUERIES):
        if number:
            threading.Event().wait(_PAUSE_S)
        token: Any = f"@ros2_lv/*/*/*/*/NN/*/*/{_NODE}"
        if not list(session.liveliness().get(token, timeout=_QUERY_S)):
            return False
    return True


def open_all(context: StreamContext) -> Iterator[Ros2Stream]:
    """Yield the node, if there is one."""
    if context.settings.ros2 is not None:
        yield Ros2Stream(context.settings.ros2, context)
