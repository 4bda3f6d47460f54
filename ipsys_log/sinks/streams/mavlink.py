"""MAVLink stream: the pose of one robot to its autopilot (PX4, ArduPilot), by UDP, in its axes.

The autopilots PX4 and ArduPilot expect x forward (here: north), y right (east) and z down, and angles
clockwise from north, seen from above. docs/streams.md lists what each autopilot does with each field.
"""

import select
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from math import cos, nan, pi, sin
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Message, Tracks
from ipsys_log.sinks.sink import DropReport, Warn
from ipsys_log.sinks.streams.addresses import find_destination, is_loopback, local_address, open_datagrams
from ipsys_log.sinks.streams.poses import NewSession, PoseSource, StreamContext, StreamPose
from ipsys_log.vision.bodies import rpy_from_rotation
from ipsys_log.vision.poses import rotation_vector, turn_about_z, vector_quaternion

_NS_PER_US = 1000
_RESETS = 256
# A heading without a stated sigma. The autopilots need a number: this one is the default of PX4.
_UNKNOWN_YAW_SIGMA_RAD = 0.1
# From the axes forward, right, down of autopilots to those of ROS: forward, left, up.
_FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
# The cosine of the pitch above which the uncertainty of the yaw grows no more: it stays finite.
_LEAST_COSINE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class _LocalPose:
    """A pose in the axes north, east, down, in m and rad; velocities along and about the axes of the robot.

    ``turn_rad`` is the rotation vector, and ``rpy_rad`` has roll, pitch and yaw. Covariances are the upper
    triangles, row by row, of 6 x 6: along three axes, and of roll, pitch and yaw.
    """

    position_m: Array
    turn_rad: Array
    rpy_rad: tuple[float, float, float]
    velocity_m_s: Array
    rates_rad_s: Array
    covariance: list[float]
    velocity_covariance: list[float]


def encode_odometry(pose: StreamPose, north_rad: float) -> Any:
    """Return the message ODOMETRY, from LOCAL_FRD to BODY_FRD.

    The estimator is VISION: PX4 gives the poses of MOCAP to a topic that its filter does not read. An unknown
    velocity is NaN, and an unknown covariance begins with NaN.

    ``north_rad`` is the direction of north, from the x axis of the lab to its y axis.
    """
    local = _localize(pose, north_rad)
    x, y, z, w = vector_quaternion(local.turn_rad)
    return common.MAVLink_odometry_message(
        pose.time_ns // _NS_PER_US,
        common.MAV_FRAME_LOCAL_FRD,
        common.MAV_FRAME_BODY_FRD,
        *local.position_m.tolist(),
        [w, x, y, z],
        *local.velocity_m_s.tolist(),
        *local.rates_rad_s.tolist(),
        local.covariance,
        local.velocity_covariance,
        pose.session % _RESETS,
        common.MAV_ESTIMATOR_TYPE_VISION,
    )


def encode_vision(pose: StreamPose, north_rad: float) -> Any:
    """Return the message VISION_POSITION_ESTIMATE with Euler angles; parameters as for ODOMETRY."""
    local = _localize(pose, north_rad)
    return common.MAVLink_vision_position_estimate_message(
        pose.time_ns // _NS_PER_US,
        *local.position_m.tolist(),
        *local.rpy_rad,
        local.covariance,
        pose.session % _RESETS,
    )


def _localize(pose: StreamPose, north_rad: float) -> _LocalPose:
    track, velocity = pose.track, pose.velocity
    local_from_world = np.array(
        [[cos(north_rad), sin(north_rad), 0], [sin(north_rad), -cos(north_rad), 0], [0, 0, -1]]
    )
    # A level robot has no roll and pitch, not even by rounding.
    yaw_rad = (north_rad - (track.heading_rad or 0.0) + pi) % (2 * pi) - pi
    local_from_body, rpy_rad = turn_about_z(yaw_rad), (0.0, 0.0, yaw_rad)
    turn_rad = np.array(rpy_rad)
    if track.rotation_rad is not None:
        local_from_body = local_from_world @ pose.rotation @ _FLU_FROM_FRD
        rpy_rad, turn_rad = rpy_from_rotation(local_from_body), rotation_vector(local_from_body)
    velocity_m_s, rates_rad_s, velocity_covariance = np.full(3, nan), np.full(3, nan), _upper(None, nan)
    if velocity is not None:
        body_from_world = np.ascontiguousarray(local_from_body.T) @ local_from_world
        velocity_m_s = body_from_world @ np.array([velocity.x_m_s, velocity.y_m_s, velocity.z_m_s])
        if velocity.angular_rad_s is not None:
            rates_rad_s = body_from_world @ velocity.angular_rad_s
        elif velocity.yaw_rad_s is not None:
            rates_rad_s[2] = -velocity.yaw_rad_s
        known, turning = velocity.covariance_m2_s2, velocity.angular_covariance_rad2_s2
        # The uncertainty about the vertical gives none about the axes of a tilted robot.
        sigma_rad_s = velocity.yaw_sigma_rad_s if velocity.angular_rad_s is None else None
        velocity_covariance = _upper(
            None if known is None else body_from_world @ known @ body_from_world.T,
            nan if sigma_rad_s is None else sigma_rad_s,
            None if turning is None else body_from_world @ turning @ body_from_world.T,
        )
    known, sigma_rad = pose.covariance_m2, pose.heading_sigma_rad
    covariance = _upper(
        None if known is None else local_from_world @ known @ local_from_world.T,
        _UNKNOWN_YAW_SIGMA_RAD if sigma_rad is None else sigma_rad,
    )
    if pose.covariance is not None:
        covariance = _rpy_covariance(pose.covariance, local_from_world, rpy_rad)
    position_m = local_from_world @ np.array([track.x_m, track.y_m, track.z_m])
    motion = velocity_m_s, rates_rad_s, covariance, velocity_covariance
    return _LocalPose(position_m, turn_rad, rpy_rad, *motion)


def _rpy_covariance(
    known: Array, local_from_world: Array, rpy_rad: tuple[float, float, float]
) -> list[float]:
    """Return the upper triangle of the covariance of x, y, z, roll, pitch and yaw.

    ``known`` (6, 6) is that of x, y, z and of a turn about the axes of the world.
    """
    _, pitch_rad, yaw_rad = rpy_rad
    # The axes of roll, pitch and yaw. Those of roll and yaw are the same at a pitch of 90 degrees.
    steep = max(cos(pitch_rad), _LEAST_COSINE)
    axes = turn_about_z(yaw_rad) @ np.array([[steep, 0, 0], [0, 1, 0], [-sin(pitch_rad), 0, 1]])
    local = np.zeros((6, 6))
    local[:3, :3], local[3:, 3:] = local_from_world, np.linalg.solve(axes, local_from_world)
    return _triangle(local @ known @ local.T)


def _upper(known: Array | None, yaw_sigma: float, turning: Array | None = None) -> list[float]:
    """Return the upper triangle of a covariance of 6 x 6; it begins with NaN if ``known`` is None.

    ``known`` (3, 3) is the part of x, y and z, and ``yaw_sigma`` the standard deviation about z. A level
    vehicle has the same about x and y: ArduPilot adds the three variances, and PX4 uses none if one is NaN.
    ``turning`` (3, 3) is that about all axes of a free body.
    """
    covariance = np.diag(np.full(6, yaw_sigma**2))
    if turning is not None:
        covariance[3:, 3:] = turning
    covariance[:3, :3] = nan if known is None else known
    return _triangle(covariance)


def _triangle(covariance: Array) -> list[float]:
    upper: list[float] = covariance[np.triu_indices(6)].tolist()
    return upper


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
    """Return the endpoint ``ROBOT=HOST:PORT`` or ``ROBOT=HOST:PORT/vision``."""
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
        self._encode = _MESSAGES[endpoint.message]
        self._poses, self._now_ns, self._north_rad = poses, now_ns, north_rad
        self.drops = DropReport(self.name, warn)
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

    def send(self, message: Message) -> None:
        """Send the poses of a message."""
        for pose in self._poses.read(message):
            if pose.is_sendable and pose.time_ns >= 0:
                self._send(self._encode(pose, self._north_rad))

    def close(self) -> None:
        """Close the socket."""
        self.drops.finish()
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
            self.drops.add("the system has no room for more datagrams")
        except OSError as error:
            self.drops.add(str(error.strerror))

    def _beat(self) -> None:
        """Tell the autopilot once a second that this program runs, and whether positions are in time."""
        while True:
            state = self._poses.state
            is_live = state is None or state.state == "live"
            self._send(
                common.MAVLink_heartbeat_message(
                    common.MAV_TYPE_ONBOARD_CONTROLLER,
                    common.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    common.MAV_STATE_ACTIVE if is_live else common.MAV_STATE_CRITICAL,
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
