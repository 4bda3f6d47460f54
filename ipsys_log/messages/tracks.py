"""Payloads in world coordinates: positions of each camera, tracks of robots, transforms for viewers.

The waypoints of robot runs are here, too, with the commands to the wheels that follow from positions.
"""

from dataclasses import dataclass

from ipsys_log.messages.message import Floats, Mat33, Mat66, TimeNs, Vec3, Vec6

# The states of a controller: it stands at a waypoint while it is holding, and after the last one when it is
# finished. It is stopped while it gets no positions.
DRIVING, HOLDING, STOPPED, FINISHED = "driving", "holding", "stopped", "finished"


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """The world position of a marker by one camera.

    ``inside`` tells whether it lies in the volume of the calibration points; None if this is unknown.
    ``noise_m2`` is the part of ``covariance_m2`` that is new in each frame, without the errors of the
    calibration. ``heading_noise_rad`` is the same part of the heading, as a standard deviation.

    The position of a body that is not level is that of its origin, with the id of its first marker. It has
    the rotation vector ``rotation_rad`` from the axes of the body to those of the world. The other fields are
    those of a body that stands still, see ``schemas/ipsys/v1/positions.proto``; ``error_modes`` is (7 * n,).
    """

    id: int
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float | None = None
    covariance_m2: Mat33 | None = None
    inside: bool | None = None
    time_offset_ns: int | None = None
    noise_m2: Mat33 | None = None
    heading_noise_rad: float | None = None
    rotation_rad: Vec3 | None = None
    to_still: Vec6 | None = None
    still_noise: Mat66 | None = None
    still_by_motion: Mat66 | None = None
    error_modes: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    timestamp: TimeNs
    positions: tuple[Position, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The pose of a robot at one instant, from all sightings up to then, and its motion.

    ``cameras`` are those of the recent sightings. ``coasting_ns`` is the time since the last sighting, in a
    pose that is predicted because no camera sees the robot; otherwise None. ``age_ns`` is the time since the
    first sighting of the track: a robot that is carried away begins a new track.

    A body that is not level has the rotation vector ``rotation_rad`` from its axes to those of the world, the
    ``pose_covariance`` of its position and of a turn about the axes of the world, and the angular velocity
    about these axes. Its heading is that of its x axis.
    """

    robot: str
    id: int
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float | None = None
    covariance_m2: Mat33 | None = None
    cameras: tuple[str, ...] = ()
    inside: bool | None = None
    velocity_m_s: Vec3 | None = None
    velocity_covariance_m2_s2: Mat33 | None = None
    heading_sigma_rad: float | None = None
    turn_rate_rad_s: float | None = None
    turn_rate_sigma_rad_s: float | None = None
    coasting_ns: int | None = None
    age_ns: int | None = None
    rotation_rad: Vec3 | None = None
    pose_covariance: Mat66 | None = None
    angular_velocity_rad_s: Vec3 | None = None
    angular_velocity_covariance_rad2_s2: Mat33 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    timestamp: TimeNs
    tracks: tuple[Track, ...]


@dataclass(frozen=True, slots=True)
class Vector3:
    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class Quaternion:
    x: float
    y: float
    z: float
    w: float


@dataclass(frozen=True, slots=True)
class FrameTransform:
    timestamp: TimeNs
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


@dataclass(frozen=True, slots=True)
class FrameTransforms:
    transforms: tuple[FrameTransform, ...]


@dataclass(frozen=True, slots=True)
class Waypoint:
    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True)
class RobotPath:
    """The waypoints of a robot, in the order of the drive."""

    timestamp: TimeNs
    robot: str
    waypoints: tuple[Waypoint, ...]


@dataclass(frozen=True, slots=True)
class WheelCommand:
    """The command of a controller to the wheels of its robot, at the time when the wheels got it.

    The speeds are those of the wheels on the floor. ``waypoint`` is the number of the waypoint that the robot
    drives to or stands at, from 1. ``x_m``, ``y_m`` and ``position_time`` are the received position that the
    command follows from, and its capture time.
    """

    timestamp: TimeNs
    robot: str
    left_m_s: float
    right_m_s: float
    state: str | None = None
    waypoint: int | None = None
    x_m: float | None = None
    y_m: float | None = None
    position_time: TimeNs | None = None
