"""Poses as serialised messages of ROS 2: axes and frames by REP 103 and REP 105.

The axes of the lab are those of the frame ``map``: x and y on the floor, z up, m and rad. The frame of a
robot has the robot's name; its origin is the marker, and x points along the heading.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import cos, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from ipsys_log.sinks.streams.poses import StreamPose, Velocity
from ipsys_log.units import NS_PER_S

__all__ = [
    "CLOCK",
    "DIAGNOSTICS",
    "MAP",
    "ODOMETRY",
    "POSE",
    "TF",
    "encode_clock",
    "encode_diagnostics",
    "encode_floors",
    "encode_odometry",
    "encode_pose",
    "encode_transforms",
    "is_stampable",
    "type_hash",
]

MAP = "map"
TF, CLOCK = "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock"
POSE, ODOMETRY = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

# An unknown variance in m^2, rad^2, (m/s)^2 or (rad/s)^2: filters of ROS read 0 as exact, and refuse NaN.
_UNKNOWN = 1e6
# Jazzy and Kilted have the same definitions of these messages.
_STORE = get_typestore(Stores.ROS2_JAZZY)
_LAST_S = 2**31


def type_hash(ros_type: str) -> str:
    """Return the hash of a message type (REP 2016), ``RIHS01_`` and 64 characters."""
    return str(_STORE.hash_rihs01(ros_type))


def is_stampable(time_ns: int) -> bool:
    """Return whether a stamp of ROS 2 can hold a time: it ends in 2038."""
    return 0 <= time_ns < _LAST_S * NS_PER_S


def _make(name: str, *values: Any) -> Any:
    package, _, short = name.partition("/")
    return _STORE.types[f"{package}/msg/{short}"](*values)


def _encode(message: Any, ros_type: str) -> bytes:
    return bytes(_STORE.serialize_cdr(message, ros_type))


def _time(time_ns: int) -> Any:
    return _make("builtin_interfaces/Time", *divmod(time_ns, NS_PER_S))


def _header(time_ns: int, frame: str) -> Any:
    return _make("std_msgs/Header", _time(time_ns), frame)


def _rotation(heading_rad: float) -> Any:
    return _make("geometry_msgs/Quaternion", 0.0, 0.0, sin(heading_rad / 2), cos(heading_rad / 2))


def _transform(time_ns: int, parent: str, child: str, xyz_m: tuple[float, ...], heading_rad: float) -> Any:
    moved = _make("geometry_msgs/Transform", _make("geometry_msgs/Vector3", *xyz_m), _rotation(heading_rad))
    return _make("geometry_msgs/TransformStamped", _header(time_ns, parent), child, moved)


def encode_transforms(poses: Iterable[tuple[StreamPose, float]]) -> bytes:
    """Return the message of ``/tf`` with poses and their headings in rad."""
    rows = [
        _transform(
            pose.time_ns, MAP, pose.track.robot, (pose.track.x_m, pose.track.y_m, pose.track.z_m), heading_rad
        )
        for pose, heading_rad in poses
    ]
    return _encode(_make("tf2_msgs/TFMessage", rows), TF)


def encode_floors(heights_m: Mapping[str, float], time_ns: int) -> bytes:
    """Return the message of ``/tf_static``: the frame ``<robot>/floor`` below the marker of each robot."""
    rows = [
        _transform(time_ns, robot, f"{robot}/floor", (0.0, 0.0, -height_m), 0.0)
        for robot, height_m in heights_m.items()
    ]
    return _encode(_make("tf2_msgs/TFMessage", rows), TF)


def encode_clock(time_ns: int) -> bytes:
    """Return the message of ``/clock``."""
    return _encode(_make("rosgraph_msgs/Clock", _time(time_ns)), CLOCK)


def encode_pose(pose: StreamPose, heading_rad: float) -> bytes:
    """Return the message PoseWithCovarianceStamped of a pose."""
    message = _make(
        "geometry_msgs/PoseWithCovarianceStamped", _header(pose.time_ns, MAP), _pose(pose, heading_rad)
    )
    return _encode(message, POSE)


def encode_odometry(pose: StreamPose, heading_rad: float, velocity: Velocity) -> bytes:
    """Return the message Odometry of a pose; the velocity is along the axes of the robot."""
    body_from_map = np.array(
        [[cos(heading_rad), sin(heading_rad), 0], [-sin(heading_rad), cos(heading_rad), 0], [0, 0, 1]]
    )
    in_map_m_s = np.array([velocity.x_m_s, velocity.y_m_s, velocity.z_m_s])
    linear = _make("geometry_msgs/Vector3", *(body_from_map @ in_map_m_s).tolist())
    angular = _make("geometry_msgs/Vector3", 0.0, 0.0, velocity.yaw_rad_s or 0.0)
    known = velocity.covariance_m2_s2
    covariance = _covariance(
        None if known is None else body_from_map @ known @ body_from_map.T,
        None if velocity.yaw_rad_s is None else velocity.yaw_sigma_rad_s,
    )
    twist = _make(
        "geometry_msgs/TwistWithCovariance", _make("geometry_msgs/Twist", linear, angular), covariance
    )
    header = _header(pose.time_ns, MAP)
    message = _make("nav_msgs/Odometry", header, pose.track.robot, _pose(pose, heading_rad), twist)
    return _encode(message, ODOMETRY)


def _pose(pose: StreamPose, heading_rad: float) -> Any:
    track = pose.track
    point = _make("geometry_msgs/Point", track.x_m, track.y_m, track.z_m)
    where = _make("geometry_msgs/Pose", point, _rotation(heading_rad))
    return _make(
        "geometry_msgs/PoseWithCovariance", where, _covariance(pose.covariance_m2, pose.heading_sigma_rad)
    )


def _covariance(known: NDArray[np.float64] | None, yaw_sigma: float | None) -> NDArray[np.float64]:
    """Return a covariance of 6 x 6, row by row.

    ``known`` (3, 3) is the part of x, y and z, and ``yaw_sigma`` the standard deviation about z. All other
    variances are unknown.
    """
    covariance = np.eye(6) * _UNKNOWN
    if known is not None:
        covariance[:3, :3] = known
    if yaw_sigma is not None:
        covariance[5, 5] = yaw_sigma**2
    return covariance.ravel()


def encode_diagnostics(
    newest: Mapping[str, StreamPose | None], session: int, now_ns: int, stale_s: float
) -> bytes:
    """Return the message DiagnosticArray: a status for each robot, with the age and the accuracy of its pose.

    Parameters
    ----------
    newest : the newest pose of each robot; None: no camera has seen it.
    """
    rows = [_status(robot, pose, session, now_ns, stale_s) for robot, pose in newest.items()]
    message = _make("diagnostic_msgs/DiagnosticArray", _header(now_ns, ""), rows)
    return _encode(message, DIAGNOSTICS)


def _status(robot: str, pose: StreamPose | None, session: int, now_ns: int, stale_s: float) -> Any:
    status: Any = _STORE.types["diagnostic_msgs/msg/DiagnosticStatus"]
    values = {"session": str(session)}
    level, text = status.STALE, "no camera has seen the robot"
    if pose is not None:
        age_s = (now_ns - pose.time_ns) / NS_PER_S
        values |= {"age_s": f"{age_s:.3f}", "cameras": " ".join(pose.track.cameras)}
        if pose.covariance_m2 is not None:
            values["sigma_m"] = f"{sqrt(max(np.trace(pose.covariance_m2) / 3, 0.0)):.4f}"
        level, text = _judge(pose, age_s, stale_s, status)
    rows = [_make("diagnostic_msgs/KeyValue", key, value) for key, value in values.items()]
    return status(level, f"ipsys: {robot}", text, robot, rows)


def _judge(pose: StreamPose, age_s: float, stale_s: float, status: Any) -> tuple[int, str]:
    if age_s > stale_s:
        return status.STALE, f"no position for {age_s:.1f} s"
    if pose.is_outside:
        return status.WARN, "outside the calibrated volume; the position is withheld"
    if pose.track.heading_rad is None:
        return status.WARN, "without heading; the position is withheld"
    return status.OK, "position is current"
