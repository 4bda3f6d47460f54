"""Poses as MAVLink messages: axes north, east, down instead of those of the lab, and covariances.

The autopilots PX4 and ArduPilot expect x forward (here: north), y right (east) and z down, and angles
clockwise from north, seen from above. docs/streams.md lists what each autopilot does with each field.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, nan, pi, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from ipsys_log.sinks.streams.poses import StreamPose

# The direction of north by default: the y axis of the lab.
NORTH_RAD = pi / 2
_NS_PER_US = 1000
_RESETS = 256
# A heading without a stated sigma. The autopilots need a number: this one is the default of PX4.
_UNKNOWN_YAW_SIGMA_RAD = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class _LocalPose:
    """A pose in the axes north, east, down, in m and rad; velocities along the axes of the robot.

    Covariances are the upper triangles, row by row, of 6 x 6: along three axes, and about them.
    """

    position_m: NDArray[np.float64]
    yaw_rad: float
    velocity_m_s: NDArray[np.float64]
    yaw_rad_s: float
    covariance: list[float]
    velocity_covariance: list[float]


def encode_odometry(pose: StreamPose, heading_rad: float, north_rad: float) -> Any:
    """Return the message ODOMETRY, from LOCAL_FRD to BODY_FRD.

    The estimator is VISION: PX4 gives the poses of MOCAP to a topic that its filter does not read. An unknown
    velocity is NaN, and an unknown covariance begins with NaN.

    Parameters
    ----------
    heading_rad : the heading of the robot, from the x axis of the lab to its y axis.
    north_rad : the direction of north, from the x axis of the lab to its y axis.
    """
    local = _localize(pose, heading_rad, north_rad)
    turn = [cos(local.yaw_rad / 2), 0.0, 0.0, sin(local.yaw_rad / 2)]
    return common.MAVLink_odometry_message(
        pose.time_ns // _NS_PER_US,
        common.MAV_FRAME_LOCAL_FRD,
        common.MAV_FRAME_BODY_FRD,
        *local.position_m.tolist(),
        turn,
        *local.velocity_m_s.tolist(),
        nan,
        nan,
        local.yaw_rad_s,
        local.covariance,
        local.velocity_covariance,
        pose.session % _RESETS,
        common.MAV_ESTIMATOR_TYPE_VISION,
    )


def encode_vision(pose: StreamPose, heading_rad: float, north_rad: float) -> Any:
    """Return the message VISION_POSITION_ESTIMATE with Euler angles; parameters as for ODOMETRY."""
    local = _localize(pose, heading_rad, north_rad)
    return common.MAVLink_vision_position_estimate_message(
        pose.time_ns // _NS_PER_US,
        *local.position_m.tolist(),
        0.0,
        0.0,
        local.yaw_rad,
        local.covariance,
        pose.session % _RESETS,
    )


def _localize(pose: StreamPose, heading_rad: float, north_rad: float) -> _LocalPose:
    track, velocity = pose.track, pose.velocity
    local_from_world = np.array(
        [[cos(north_rad), sin(north_rad), 0], [sin(north_rad), -cos(north_rad), 0], [0, 0, -1]]
    )
    yaw_rad = (north_rad - heading_rad + pi) % (2 * pi) - pi
    velocity_m_s, yaw_rad_s, velocity_covariance = np.full(3, nan), nan, _upper(None, nan)
    if velocity is not None:
        body_from_local = np.array(
            [[cos(yaw_rad), sin(yaw_rad), 0], [-sin(yaw_rad), cos(yaw_rad), 0], [0, 0, 1]]
        )
        body_from_world = body_from_local @ local_from_world
        velocity_m_s = body_from_world @ np.array([velocity.x_m_s, velocity.y_m_s, velocity.z_m_s])
        yaw_rad_s = nan if velocity.yaw_rad_s is None else -velocity.yaw_rad_s
        known = velocity.covariance_m2_s2
        velocity_covariance = _upper(
            None if known is None else body_from_world @ known @ body_from_world.T,
            nan if velocity.yaw_sigma_rad_s is None else velocity.yaw_sigma_rad_s,
        )
    known, sigma_rad = pose.covariance_m2, pose.heading_sigma_rad
    covariance = _upper(
        None if known is None else local_from_world @ known @ local_from_world.T,
        _UNKNOWN_YAW_SIGMA_RAD if sigma_rad is None else sigma_rad,
    )
    position_m = local_from_world @ np.array([track.x_m, track.y_m, track.z_m])
    return _LocalPose(position_m, yaw_rad, velocity_m_s, yaw_rad_s, covariance, velocity_covariance)


def _upper(known: NDArray[np.float64] | None, yaw_sigma: float) -> list[float]:
    """Return the upper triangle of a covariance of 6 x 6; it begins with NaN if ``known`` is None.

    ``known`` (3, 3) is the part of x, y and z, and ``yaw_sigma`` the standard deviation about z. A level
    vehicle has the same about x and y: ArduPilot adds the three variances, and PX4 uses none if one is NaN.
    """
    covariance = np.diag(np.full(6, yaw_sigma**2))
    covariance[:3, :3] = nan if known is None else known
    upper: list[float] = covariance[np.triu_indices(6)].tolist()
    return upper
