"""The poses that streams send: position, velocity, covariance, age, and the number of the session."""

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Message, Track, Tracks
from ipsys_log.messages.message import Mat33, Mat66, Vec3
from ipsys_log.sinks.sink import Warn
from ipsys_log.sinks.streams import STALE_S, StreamSettings
from ipsys_log.statistics.latency import PositionMonitor, PositionState
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import track_quaternion, track_rotation

# Tracks of earlier versions have no velocity. The duration of the poses that give one: a longer one is more
# precise, and later by half of it.
_WINDOW_NS, _SHORTEST_NS = NS_PER_S // 5, NS_PER_S // 20
_FEWEST_POSES = 3
_NS_PER_MS = NS_PER_S // 1000

_Value = TypeVar("_Value", NDArray[np.float64], float)


@dataclass(frozen=True, slots=True)
class NewSession:
    """The payload that begins a session: from here on, times may be earlier than before."""

    number: int


def first_session(now_ns: int) -> int:
    """Return the number of a session that begins now: it is larger than those of earlier programs."""
    return now_ns // _NS_PER_MS


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """The velocity of a robot in m/s, and the rate of its heading in rad/s (None: headings are missing).

    ``covariance_m2_s2`` (3, 3) and ``yaw_sigma_rad_s`` are their uncertainties; None if these are unknown.
    ``angular_rad_s`` (3,) is the angular velocity of a robot that is not level, with the covariance
    ``angular_covariance_rad2_s2`` (3, 3); all are in the axes of the world.
    """

    x_m_s: float
    y_m_s: float
    z_m_s: float
    yaw_rad_s: float | None
    covariance_m2_s2: Mat33 | None = None
    yaw_sigma_rad_s: float | None = None
    angular_rad_s: Vec3 | None = None
    angular_covariance_rad2_s2: Mat33 | None = None

    @property
    def turn_rad_s(self) -> Vec3:
        """The angular velocity (3,) of any robot; unknown parts are 0."""
        level_rad_s = np.array([0.0, 0.0, self.yaw_rad_s or 0.0])
        return level_rad_s if self.angular_rad_s is None else self.angular_rad_s


@dataclass(frozen=True, slots=True, eq=False)
class StreamPose:
    """The pose of a robot at one instant.

    Attributes
    ----------
    session, sequence : both increase; the sequence begins with 1 in each session.
    time_ns, age_s : the capture time, and the time since then by the clock of the stream.
    is_stale : the last sighting of the robot is older than the limit.
    is_late : all positions of the live run are late; None if this is unknown.
    is_outside : the position is an extrapolation outside the calibrated volume; None if this is unknown.
    """

    session: int
    sequence: int
    time_ns: int
    age_s: float
    track: Track
    velocity: Velocity | None
    is_stale: bool
    is_late: bool | None = None

    @property
    def is_outside(self) -> bool | None:
        return None if self.track.inside is None else not self.track.inside

    @property
    def is_good(self) -> bool:
        """Return whether a protocol without flags may send the position."""
        return not self.is_stale and not self.is_outside

    @property
    def is_sendable(self) -> bool:
        """Return whether a protocol without flags may send the position with its rotation."""
        return self.is_good and self.track.heading_rad is not None

    @property
    def rotation(self) -> Array:
        """The rotation (3, 3) from the axes of the robot to those of the world."""
        return track_rotation(self.track)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """The same as a quaternion (x, y, z, w)."""
        return track_quaternion(self.track)

    @property
    def covariance(self) -> Mat66 | None:
        """The covariance of x, y, z and of a turn about the axes of the world; None for a level robot."""
        return _finite(self.track.pose_covariance)

    @property
    def covariance_m2(self) -> Mat33 | None:
        return _finite(self.track.covariance_m2)

    @property
    def heading_sigma_rad(self) -> float | None:
        return _finite(self.track.heading_sigma_rad)


class PoseSource:
    """The poses of robots from messages of tracks. Each stream has its own source.

    A pose that is older than the last one of its robot is left out: it arrived late.

    Parameters
    ----------
    topics : the topics of the tracks.
    robots : the names of the robots; empty: all.
    now_ns : the clock of the ages.
    session : the number of the first session.
    stale_s : the age from which a pose is stale.
    positions : the state of the positions of a live run.
    """

    def __init__(
        self,
        topics: Collection[str],
        now_ns: Callable[[], int],
        session: int,
        robots: Collection[str] = (),
        stale_s: float = STALE_S,
        positions: PositionMonitor | None = None,
    ) -> None:
        self._positions = positions
        self._topics, self._robots, self._now_ns = frozenset(topics), frozenset(robots), now_ns
        self._session, self._sequence, self._stale_s = session, 0, stale_s
        self._recent: dict[str, _Recent] = {}

    @property
    def session(self) -> int:
        """The number of the session."""
        return self._session

    @property
    def stale_s(self) -> float:
        """The age from which a pose is stale, in s."""
        return self._stale_s

    @property
    def state(self) -> PositionState | None:
        """The state of all positions of a live run; None if it is not known."""
        return None if self._positions is None else self._positions.state

    def read(self, message: Message) -> Iterator[StreamPose]:
        """Yield the poses of a message; a new session forgets all earlier poses."""
        if isinstance(message.payload, NewSession):
            self._session, self._sequence = message.payload.number, 0
            self._recent.clear()
        elif message.topic in self._topics and isinstance(message.payload, Tracks):
            state = self.state
            is_late = None if state is None else state.state == "late"
            for track in message.payload.tracks:
                if (not self._robots or track.robot in self._robots) and _is_finite(track):
                    yield from self._poses(track, message.payload.timestamp, is_late)

    def _poses(self, track: Track, time_ns: int, is_late: bool | None) -> Iterator[StreamPose]:
        recent = self._recent.setdefault(track.robot, _Recent())
        if not recent.add(time_ns, track):
            return
        self._sequence += 1
        age_s = (self._now_ns() - time_ns) / NS_PER_S
        unseen_s = age_s + (track.coasting_ns or 0) / NS_PER_S
        is_stale = unseen_s > self._stale_s
        yield StreamPose(
            self._session, self._sequence, time_ns, age_s, track, recent.velocity(), is_stale, is_late
        )


@dataclass(frozen=True, slots=True)
class StreamContext:
    """The inputs that the streams of a command share.

    Attributes
    ----------
    topics : the topics of the tracks.
    now_ns : the clock of the ages.
    warn : makes an event for lost messages.
    session : the number of the first session.
    heights_m : all robots of the rig, announced before they are seen, with the heights of their markers
        (None: unknown).
    is_replayed : the times are those of a recording.
    positions : the state of the positions of a live run.
    """

    settings: StreamSettings
    topics: Collection[str]
    now_ns: Callable[[], int]
    warn: Warn
    session: int
    heights_m: Mapping[str, float | None] = field(default_factory=dict)
    is_replayed: bool = False
    positions: PositionMonitor | None = None

    @property
    def streamed_heights_m(self) -> dict[str, float | None]:
        """The robots of the rig that the streams send, with the heights of their markers."""
        robots = self.settings.robots or self.heights_m
        return {name: height_m for name, height_m in self.heights_m.items() if name in robots}

    def poses(self, robots: Collection[str] = ()) -> PoseSource:
        """Return the poses of some robots; without names, those of the settings."""
        named = robots or self.settings.robots
        return PoseSource(
            self.topics, self.now_ns, self.session, named, self.settings.stale_s, self.positions
        )


def _finite(value: _Value | None) -> _Value | None:
    """Return a value; None if a part of it is no number: a log of another program may hold such values."""
    return value if value is not None and np.isfinite(value).all() else None


def _is_finite(track: Track) -> bool:
    """Return whether a pose is a number; a log of another program may hold others."""
    turn_rad = () if track.rotation_rad is None else track.rotation_rad.tolist()
    return all(map(isfinite, (track.x_m, track.y_m, track.z_m, track.heading_rad or 0.0, *turn_rad)))


class _Recent:
    """The recent poses of one robot, and its velocity."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, Track]] = deque()

    def add(self, time_ns: int, track: Track) -> bool:
        """Add a pose; return False if it is older than the last one. One of the same time replaces it."""
        poses = self._poses
        if poses and time_ns < poses[-1][0]:
            return False
        if poses and time_ns == poses[-1][0]:
            poses.pop()
        poses.append((time_ns, track))
        while time_ns - poses[0][0] > _WINDOW_NS:
            poses.popleft()
        return True

    def velocity(self) -> Velocity | None:
        """Return the velocity of the newest track; that of the recent poses if the track has none."""
        newest = self._poses[-1][1]
        if newest.velocity_m_s is None or not np.isfinite(newest.velocity_m_s).all():
            return self._slope()
        x_m_s, y_m_s, z_m_s = newest.velocity_m_s.tolist()
        sigmas = _finite(newest.velocity_covariance_m2_s2), _finite(newest.turn_rate_sigma_rad_s)
        turn = _finite(newest.turn_rate_rad_s), *sigmas, _finite(newest.angular_velocity_rad_s)
        return Velocity(x_m_s, y_m_s, z_m_s, *turn, _finite(newest.angular_velocity_covariance_rad2_s2))

    def _slope(self) -> Velocity | None:
        """Return the slope of the poses; None if the poses are too few, or their time is too short."""
        first_ns, last_ns = self._poses[0][0], self._poses[-1][0]
        if len(self._poses) < _FEWEST_POSES or last_ns - first_ns < _SHORTEST_NS:
            return None
        times_s = np.array([time_ns - first_ns for time_ns, _ in self._poses]) / NS_PER_S
        tracks = [track for _, track in self._poses]
        headings = [track.heading_rad for track in tracks if track.heading_rad is not None]
        columns = [[track.x_m for track in tracks], [track.y_m for track in tracks], [t.z_m for t in tracks]]
        if len(headings) == len(tracks):
            columns.append(np.unwrap(headings).tolist())
        centred_s = times_s - times_s.mean()
        slopes = (np.array(columns) @ centred_s / (centred_s @ centred_s)).tolist()
        return Velocity(slopes[0], slopes[1], slopes[2], slopes[3] if len(slopes) > 3 else None)
