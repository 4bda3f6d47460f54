"""MAVLink stream: the pose of one robot to its autopilot (PX4, ArduPilot), by UDP."""

from __future__ import annotations

import select
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message, Tracks
from ipsys_log.sinks.sink import DropReport, Warn
from ipsys_log.sinks.streams.addresses import find_destination, is_loopback, local_address, open_datagrams
from ipsys_log.sinks.streams.mavlink_messages import encode_odometry, encode_vision
from ipsys_log.sinks.streams.poses import NewSession, PoseSource, StreamContext

# The autopilot takes messages from a companion computer with its own system number.
_SYSTEM, _COMPONENT = 1, common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_HEARTBEAT_S = 1.0
_TURN_S = 0.2
_MOST_BYTES = 2048
_COUNTS = 256
_MESSAGES = {"odometry": encode_odometry, "vision": encode_vision}


class Endpoint(NamedTuple):
    """The autopilot of a robot: the robot, the address, and the message that it gets."""

    robot: str
    target: str
    message: str


def parse_endpoint(text: str) -> Endpoint:
    """Return the endpoint ``ROBOT=HOST:PORT`` or ``ROBOT=HOST:PORT/vision``.

    Raises
    ------
    IpsysError
        The text has another form.
    """
    robot, equals, rest = text.partition("=")
    target, _, message = rest.partition("/")
    if not (robot and equals and target):
        raise IpsysError(f"--mavlink {text}: write ROBOT=HOST:PORT, such as ada=192.168.1.30:14550")
    if (message or "odometry") not in _MESSAGES:
        raise IpsysError(f"--mavlink {text}: message {message!r} is not known; use {' or '.join(_MESSAGES)}")
    return Endpoint(robot, target, message or "odometry")


class MavlinkStream:
    """A :class:`~ipsys_log.sinks.sink.InlineSink` that sends the pose of a robot to its autopilot.

    It answers requests of the autopilot for the time (TIMESYNC), and ignores every other message. Stale poses
    and poses outside the calibrated volume are withheld.

    Parameters
    ----------
    host : the address of this machine to send from; None: datagrams stay on this machine.
    poses : gives the poses of a message.
    now_ns : the clock of the capture times.
    north_rad : the direction of north, from the x axis of the lab to its y axis.

    Raises
    ------
    IpsysError
        The autopilot cannot be reached, or is another machine and there is no host.
    """

    payloads: tuple[type, ...] = (Tracks, NewSession)

    def __init__(
        self,
        endpoint: Endpoint,
        host: str | None,
        poses: PoseSource,
        now_ns: Callable[[], int],
        warn: Warn,
        north_rad: float,
    ) -> None:
        self.name = f"MAVLink {endpoint.robot}={endpoint.target}"
        self._robot, self._encode = endpoint.robot, _MESSAGES[endpoint.message]
        self._poses, self._now_ns, self._north_rad = poses, now_ns, north_rad
        self._drops = DropReport(self.name, warn)
        self._destination = find_destination(endpoint.target, "--mavlink")
        self._local = local_address(self._destination, host, "--mavlink")
        self._socket = open_datagrams(self._destination, self._local, "--mavlink")
        self._socket.setblocking(False)
        self._lock = threading.Lock()
        self._link: Any = common.MAVLink(None, _SYSTEM, _COMPONENT)
        self._link.robust_parsing = True
        self._ended = threading.Event()
        self._threads = [
            threading.Thread(target=run, name=self.name, daemon=True) for run in (self._beat, self._answer)
        ]
        for thread in self._threads:
            thread.start()

    def describe(self) -> str:
        """Return one line about the receivers of the positions."""
        if is_loopback(self._local):
            return f"{self.name}: only this machine"
        return f"{self.name}: sent into the network from {self._local}, not encrypted"

    @property
    def dropped_count(self) -> int:
        """The number of messages that the stream lost."""
        return self._drops.count

    def send(self, message: Message) -> None:
        """Send the poses of a message."""
        for pose in self._poses.read(message):
            heading_rad = pose.track.heading_rad
            if pose.is_good and heading_rad is not None and pose.time_ns >= 0:
                self._send(self._encode(pose, heading_rad, self._north_rad))

    def close(self) -> None:
        """Close the socket."""
        self._drops.finish()
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._socket.close()

    def _send(self, message: Any) -> None:
        with self._lock:
            data = bytes(message.pack(self._link))
            self._link.seq = (self._link.seq + 1) % _COUNTS
        try:
            self._socket.sendto(data, self._destination.address)
        except BlockingIOError:
            self._drops.add("the system has no room for more datagrams")
        except OSError as error:
            self._drops.add(str(error.strerror))

    def _beat(self) -> None:
        """Tell the autopilot once a second that this program runs."""
        while True:
            self._send(
                common.MAVLink_heartbeat_message(
                    common.MAV_TYPE_ONBOARD_CONTROLLER,
                    common.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    common.MAV_STATE_ACTIVE,
                    3,  # the version of the protocol
                )
            )
            if self._ended.wait(_HEARTBEAT_S):
                return

    def _answer(self) -> None:
        """Answer requests for the time; their time is that of the autopilot, and goes back unchanged."""
        while not self._ended.is_set():
            if not select.select([self._socket], [], [], _TURN_S)[0]:
                continue
            try:
                data, sender = self._socket.recvfrom(_MOST_BYTES)
            except OSError:  # an error of an earlier datagram
                continue
            if sender[:2] == self._destination.address:
                for message in self._parse(data):
                    if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                        self._send(common.MAVLink_timesync_message(self._now_ns(), message.ts1))

    def _parse(self, data: bytes) -> list[Any]:
        messages: list[Any] = []
        # A parser of its own for each datagram: the rest of a broken one spoils no other.
        parser = common.MAVLink(None)
        parser.robust_parsing = True
        with suppress(Exception):  # any error of the parser: the datagram is not MAVLink
            messages = parser.parse_buffer(data) or []
        return messages


def open_all(context: StreamContext) -> Iterator[MavlinkStream]:
    """Yield a stream for each autopilot."""
    host, north_rad = context.settings.host, context.settings.north_rad
    for endpoint in [parse_endpoint(text) for text in dict.fromkeys(context.settings.mavlink)]:
        poses = context.poses([endpoint.robot])
        yield MavlinkStream(endpoint, host, poses, context.now_ns, context.warn, north_rad)
