"""Messages of ROS 2: their types, and poses, images and intrinsics by REP 103 and REP 105.

The axes of the lab are those of the frame ``map``: x and y on the floor, z up, m and rad. The frame of a
robot has the robot's name: it is at its pivot (``base_link``), and x points along the heading.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from ipsys_log.errors import IpsysError
from ipsys_log.log.ros2 import ROS2_MODELS
from ipsys_log.messages import CameraCalibration, CompressedImage, CompressedVideo, RawImage
from ipsys_log.sinks.streams.poses import StreamPose, Velocity
from ipsys_log.statistics.latency import PositionState
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import quaternion

if TYPE_CHECKING:
    from ipsys_log.vision.poses import PosedCamera

# Jazzy and Kilted have the same definitions of these messages.
_STORE = get_typestore(Stores.ROS2_JAZZY)
_LAST_S = 2**31


def type_hash(ros_type: str) -> str:
    """Return the hash of a message type (REP 2016), ``RIHS01_`` and 64 characters."""
    return str(_STORE.hash_rihs01(ros_type))


def text_of(ros_type: str) -> str:
    """Return the definition of a message type with all types that it contains, as in a bag (``ros2msg``)."""
    return str(_STORE.generate_msgdef(ros_type, ros_version=2)[0])


def is_stampable(time_ns: int) -> bool:
    """Return whether a stamp of ROS 2 can hold a time: it ends in 2038."""
    return 0 <= time_ns < _LAST_S * NS_PER_S


def message_class(ros_type: str) -> Any:
    """Return the class of a message type, with its constants."""
    return _STORE.types[ros_type]


def make(name: str, *values: Any) -> Any:
    """Return a message of a type such as ``std_msgs/Header``, with the values of its fields."""
    return _class_of(name)(*values)


@cache
def _class_of(name: str) -> Any:
    package, _, short = name.partition("/")
    return message_class(f"{package}/msg/{short}")


def encode(message: Any, ros_type: str) -> bytes:
    """Return the bytes of a message."""
    return bytes(_STORE.serialize_cdr(message, ros_type))


def make_time(time_ns: int) -> Any:
    """Return the stamp of a time in ns."""
    return make("builtin_interfaces/Time", *divmod(time_ns, NS_PER_S))


def make_header(time_ns: int, frame: str) -> Any:
    """Return the header of a message: its stamp, and its coordinate frame."""
    return make("std_msgs/Header", make_time(time_ns), frame)


MAP = "map"
TF, CLOCK = "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock"
POSE, ODOMETRY = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

# An unknown variance in m^2, rad^2, (m/s)^2 or (rad/s)^2: filters of ROS read 0 as exact, and refuse NaN.
_UNKNOWN = 1e6
_ALL_UNKNOWN = np.eye(6) * _UNKNOWN
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_COMPRESSED, _RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"


def optical_frame(camera: str) -> str:
    """Return the coordinate frame of the images of a camera, with the suffix of REP 103."""
    return f"{camera}_optical_frame"


def _transform(
    time_ns: int,
    parent: str,
    child: str,
    xyz_m: Iterable[float],
    turn: Iterable[float] = (0.0, 0.0, 0.0, 1.0),
) -> Any:
    rotation = make("geometry_msgs/Quaternion", *turn)
    moved = make("geometry_msgs/Transform", make("geometry_msgs/Vector3", *xyz_m), rotation)
    return make("geometry_msgs/TransformStamped", make_header(time_ns, parent), child, moved)


def sendable(poses: Iterable[StreamPose]) -> list[StreamPose]:
    """Return the poses that ROS 2 gets: current ones, inside, with a rotation and a stamp."""
    return [pose for pose in poses if pose.is_sendable and is_stampable(pose.time_ns)]


def encode_transforms(poses: Iterable[StreamPose]) -> bytes:
    """Return the message of ``/tf`` with poses."""
    rows = []
    for pose in poses:
        track = pose.track
        xyz_m = (track.x_m, track.y_m, track.z_m)
        rows.append(_transform(pose.time_ns, MAP, track.robot, xyz_m, pose.quaternion))
    return encode(make("tf2_msgs/TFMessage", rows), TF)


def encode_static(heights_m: Mapping[str, float], time_ns: int, cameras: Iterable[PosedCamera] = ()) -> bytes:
    """Return the message of ``/tf_static``: a topic that keeps only its last message.

    Parameters
    ----------
    heights_m : by robot, the height of its marker: the frame ``<robot>/floor`` is so far below.
    cameras : cameras with a pose; the frame of their images has x right, y down and z forward (REP 103).
    """
    rows = [
        _transform(time_ns, robot, f"{robot}/floor", (0.0, 0.0, -height_m))
        for robot, height_m in heights_m.items()
    ]
    for camera in cameras:
        turn = quaternion(camera.camera_from_world.T)
        rows.append(_transform(time_ns, MAP, optical_frame(camera.name), camera.origin_m.tolist(), turn))
    return encode(make("tf2_msgs/TFMessage", rows), TF)


def encode_clock(time_ns: int) -> bytes:
    """Return the message of ``/clock``."""
    return encode(make("rosgraph_msgs/Clock", make_time(time_ns)), CLOCK)


def encode_pose(pose: StreamPose) -> bytes:
    """Return the message PoseWithCovarianceStamped of a pose."""
    header = make_header(pose.time_ns, MAP)
    return encode(make("geometry_msgs/PoseWithCovarianceStamped", header, _pose(pose)), POSE)


def encode_odometry(pose: StreamPose, velocity: Velocity) -> bytes:
    """Return the message Odometry of a pose; the velocity is along and about the axes of the robot."""
    body_from_map = np.ascontiguousarray(pose.rotation.T)
    in_map_m_s = np.array([velocity.x_m_s, velocity.y_m_s, velocity.z_m_s])
    linear = make("geometry_msgs/Vector3", *(body_from_map @ in_map_m_s).tolist())
    # The sum makes -0 to 0.
    angular = make("geometry_msgs/Vector3", *(body_from_map @ velocity.turn_rad_s + 0.0).tolist())
    known = velocity.covariance_m2_s2
    # The uncertainty about the vertical gives none about the axes of a tilted robot.
    has_yaw = velocity.yaw_rad_s is not None and velocity.angular_rad_s is None
    covariance = _covariance(
        None if known is None else body_from_map @ known @ body_from_map.T,
        velocity.yaw_sigma_rad_s if has_yaw else None,
    )
    turning = velocity.angular_covariance_rad2_s2
    if turning is not None:
        covariance[3:, 3:] = body_from_map @ turning @ body_from_map.T
    twist = make(
        "geometry_msgs/TwistWithCovariance", make("geometry_msgs/Twist", linear, angular), covariance.ravel()
    )
    header = make_header(pose.time_ns, MAP)
    message = make("nav_msgs/Odometry", header, pose.track.robot, _pose(pose), twist)
    return encode(message, ODOMETRY)


def _pose(pose: StreamPose) -> Any:
    track = pose.track
    point = make("geometry_msgs/Point", track.x_m, track.y_m, track.z_m)
    where = make("geometry_msgs/Pose", point, make("geometry_msgs/Quaternion", *pose.quaternion))
    covariance = pose.covariance
    if covariance is None:
        covariance = _covariance(pose.covariance_m2, pose.heading_sigma_rad)
    return make("geometry_msgs/PoseWithCovariance", where, covariance.ravel())


def _covariance(known: NDArray[np.float64] | None, yaw_sigma: float | None) -> NDArray[np.float64]:
    """Return a covariance (6, 6).

    ``known`` (3, 3) is the part of x, y and z, and ``yaw_sigma`` the standard deviation about z. All other
    variances are unknown.
    """
    covariance = _ALL_UNKNOWN.copy()
    if known is not None:
        covariance[:3, :3] = known
    if yaw_sigma is not None:
        covariance[5, 5] = yaw_sigma**2
    return covariance


def encode_poses(poses: Iterable[StreamPose]) -> Iterator[tuple[str, str, bytes]]:
    """Yield the messages of poses, each with its topic and its type."""
    poses = list(poses)
    if poses:
        yield "/tf", TF, encode_transforms(poses)
    for pose in poses:
        robot = pose.track.robot
        yield f"/{robot}/pose", POSE, encode_pose(pose)
        if pose.velocity is not None:
            yield f"/{robot}/odom", ODOMETRY, encode_odometry(pose, pose.velocity)


def encode_diagnostics(
    newest: Mapping[str, StreamPose | None],
    session: int,
    now_ns: int,
    stale_s: float,
    state: PositionState | None = None,
) -> bytes:
    """Return the message DiagnosticArray: a status for each robot, with the age and the accuracy of its pose.

    The state of all positions of a live run has a status of its own.

    ``newest`` is the newest pose of each robot; None: no camera has seen it.
    """
    rows = [_status(robot, pose, session, now_ns, stale_s) for robot, pose in newest.items()]
    if state is not None:
        status: Any = message_class("diagnostic_msgs/msg/DiagnosticStatus")
        levels = {"live": status.WARN if state.remedy else status.OK, "late": status.WARN}
        level = levels.get(state.state, status.STALE)
        rows.append(status(level, "ipsys: positions", str(state), "", []))
    message = make("diagnostic_msgs/DiagnosticArray", make_header(now_ns, ""), rows)
    return encode(message, DIAGNOSTICS)


def encode_image(camera: str, image: CompressedImage | RawImage | CompressedVideo) -> tuple[str, bytes]:
    """Return the type and the bytes of the message of an image; its data stay as they are."""
    if isinstance(image, CompressedVideo):
        raise IpsysError(
            f"camera {camera}: its images are {image.format} video, for which ROS 2 has no standard message; "
            "leave the images out (--without-images)"
        )
    header, data = make_header(image.timestamp, optical_frame(camera)), np.frombuffer(image.data, np.uint8)
    if isinstance(image, CompressedImage):
        return _COMPRESSED, encode(
            make("sensor_msgs/CompressedImage", header, image.format, data), _COMPRESSED
        )
    size = image.height, image.width
    message = make("sensor_msgs/Image", header, *size, image.encoding, 0, image.step, data)
    return _RAW, encode(message, _RAW)


def encode_camera_info(camera: str, lens: CameraCalibration, time_ns: int) -> bytes:
    """Return the message CameraInfo of camera intrinsics, with the stamp of an image."""
    rectification = np.eye(3) if lens.R is None else lens.R
    projection = np.column_stack([lens.K, np.zeros(3)]) if lens.P is None else lens.P
    message = make(
        "sensor_msgs/CameraInfo",
        make_header(time_ns, optical_frame(camera)),
        lens.height,
        lens.width,
        ROS2_MODELS.get(lens.distortion_model, lens.distortion_model),
        np.asarray(lens.D, dtype=np.float64).ravel(),
        *(matrix.astype(np.float64).ravel() for matrix in (lens.K, rectification, projection)),
        0,
        0,
        make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False),
    )
    return encode(message, CAMERA_INFO)


def _status(robot: str, pose: StreamPose | None, session: int, now_ns: int, stale_s: float) -> Any:
    status: Any = message_class("diagnostic_msgs/msg/DiagnosticStatus")
    values = {"session": str(session)}
    level, text = status.STALE, "no camera has seen the robot"
    if pose is not None:
        age_s = (now_ns - pose.time_ns) / NS_PER_S
        values |= {"age_s": f"{age_s:.3f}", "cameras": " ".join(pose.track.cameras)}
        if pose.covariance_m2 is not None:
            values["sigma_m"] = f"{sqrt(max(np.trace(pose.covariance_m2) / 3, 0.0)):.4f}"
        level, text = _judge(pose, age_s, stale_s, status)
    rows = [make("diagnostic_msgs/KeyValue", key, value) for key, value in values.items()]
    return status(level, f"ipsys: {robot}", text, robot, rows)


def _judge(pose: StreamPose, age_s: float, stale_s: float, status: Any) -> tuple[int, str]:
    if age_s > stale_s:
        return status.STALE, f"no position for {age_s:.1f} s"
    if pose.is_outside:
        return status.WARN, "outside the calibrated volume; the position is withheld"
    if pose.track.heading_rad is None:
        return status.WARN, "without heading; the position is withheld"
    return status.OK, "position is current"
