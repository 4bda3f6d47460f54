"""Two autopilots as receivers of poses: the values that their filters take. docs/streams.md has the rules."""

from dataclasses import dataclass
from math import atan2, hypot, isfinite, isnan, nan
from typing import Any

from pymavlink.dialects.v20 import common

# The places of the variances of x, y, z and of roll, pitch, yaw in an upper triangle by rows.
_ALONG, _ABOUT = (0, 6, 11), (15, 18, 20)
_PX4_VISUAL = (
    common.MAV_ESTIMATOR_TYPE_UNKNOWN,
    common.MAV_ESTIMATOR_TYPE_NAIVE,
    common.MAV_ESTIMATOR_TYPE_VISION,
    common.MAV_ESTIMATOR_TYPE_VIO,
)


@dataclass(frozen=True, slots=True)
class Reading:
    """The values that a filter gets: None is a value that it does not use.

    ``sigma_m``, ``yaw_sigma_rad`` and ``velocity_sigma_m_s`` are those of the message, before the noise
    floors of the autopilot; None: the autopilot takes its own parameters.
    """

    position_m: tuple[float, ...] | None = None
    sigma_m: tuple[float, ...] | None = None
    yaw_rad: float | None = None
    yaw_sigma_rad: float | None = None
    velocity_m_s: tuple[float, ...] | None = None
    velocity_sigma_m_s: tuple[float, ...] | None = None
    internal_errors: int = 0


def px4(message: Any) -> Reading:
    """Return what EKF2 of PX4 takes from ODOMETRY or VISION_POSITION_ESTIMATE."""
    if message.get_type() == "ODOMETRY":
        if message.estimator_type not in _PX4_VISUAL:
            return Reading()  # vehicle_mocap_odometry, or refused: EKF2 reads vehicle_visual_odometry only
        covariance, velocity = message.pose_covariance, (message.vx, message.vy, message.vz)
        has_frame = message.frame_id in (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_LOCAL_FRD)
        has_velocity = message.child_frame_id == common.MAV_FRAME_BODY_FRD and all(map(isfinite, velocity))
        yaw_rad = _yaw_rad(message.q) if abs(hypot(*message.q) - 1) <= 1e-5 else nan
        velocity_sigma = _sigmas(message.velocity_covariance, _ALONG) if has_velocity else None
    else:
        covariance, velocity, has_frame, has_velocity = message.covariance, (nan, nan, nan), True, False
        yaw_rad, velocity_sigma = message.yaw, None
    position_m = (message.x, message.y, message.z)
    about = _sigmas(covariance, _ABOUT)
    return Reading(
        position_m if has_frame and all(map(isfinite, position_m)) else None,
        _sigmas(covariance, _ALONG),
        yaw_rad if isfinite(yaw_rad) else None,
        None if about is None else about[2],
        velocity if has_velocity else None,
        velocity_sigma,
    )


def ardupilot(message: Any) -> Reading:
    """Return what EKF3 of ArduPilot takes from ODOMETRY or VISION_POSITION_ESTIMATE.

    Its sigmas are no standard deviations: the cube root of the sum of the squares of three variances.
    """
    if message.get_type() == "ODOMETRY":
        frames = message.frame_id, message.child_frame_id
        if frames != (common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_BODY_FRD):
            return Reading()
        covariance, yaw_rad = message.pose_covariance, _yaw_rad(message.q)
        velocity = (message.vx, message.vy, message.vz)
    else:
        covariance, yaw_rad, velocity = message.covariance, message.yaw, (nan, nan, nan)
    position_m = (message.x, message.y, message.z)
    along = about = 0.0
    if not isnan(covariance[0]):
        along, about = (sum(covariance[n] ** 2 for n in places) ** (1 / 3) for places in (_ALONG, _ABOUT))
    has_yaw = not any(map(isnan, (yaw_rad, about)))
    return Reading(
        None if any(map(isnan, (*position_m, along))) else position_m,
        (along,),
        yaw_rad if has_yaw else None,
        about,
        None if any(map(isnan, velocity)) else velocity,
        None,  # VISO_VEL_M_NSE, always
        sum(map(isnan, (along, about))),  # constrain_float() of NaN
    )


def _yaw_rad(q: Any) -> float:
    w, x, y, z = q
    return atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _sigmas(covariance: Any, places: tuple[int, ...]) -> tuple[float, ...] | None:
    variances = [covariance[n] for n in places]
    return tuple(v**0.5 for v in variances) if all(map(isfinite, variances)) else None
