"""Settings of the joint calibration: standard deviations of what is known before the fit."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class JointSettings:
    """Prior standard deviations and other settings of the joint calibration.

    Attributes
    ----------
    floor_sigma_m, floor_length_m : standard deviation and correlation length of the floor's unevenness.
    floor_sigma_spread : uncertainty of this standard deviation, as that of its logarithm. The fit estimates
        it; 0 keeps it constant.
    corner_floor_px : error of a corner of a stationary marker that the covariance of the detection does not
        contain: the rest of the lens distortion, and the print. An average over frames does not reduce it.
    focal_sigma, centre_sigma, distortion_sigma : uncertainty of a chessboard calibration: focal length
        (relative), principal point (share of the width), coefficients of the lens distortion. A usual
        calibration is better than this by a factor of two or three, but its errors are correlated: a
        diagonal prior must be as wide as the widest direction.
    nominal_focal_sigma, nominal_centre_sigma, nominal_distortion_sigma : the same for nominal intrinsics.
    edge_sigma_px : offset of edges of black into the black, after the correction by the detection.
    clock_sigma_s : offset of the clock of a camera.
    row_time_sigma_s : time between two rows, where the rig does not have it.
    point_tilt_sigma_rad : tilt of a stationary marker about either axis.
    wobble_sigma_rad, wobble_time_s : tilt of a moving marker about either axis, by the wobble of its robot
        and the slope of the floor, and the correlation time of this tilt. Sightings within this time share
        one tilt.
    scale_sigma : relative error of the printed size of a marker.
    robot_height_sigma_m : error of the height at which a robot carries its marker, where the rig has none.
    acceleration_sigma, turn_sigma : usual acceleration of a robot, in m/s^2 and rad/s^2. They bridge gaps of
        the path without sightings.
    jerk_density, turn_jerk_density : roots of the power densities of the jerk of a body in a hand, in m/s^2.5
        and rad/s^2.5.
    stamp_jitter_s : random errors of the times of frames, in sightings of such a body.
    follows_valleys : whether a fit that does not converge in the usual steps goes on with long ones.
    """

    floor_sigma_m: float = 0.001
    floor_length_m: float = 0.5
    floor_sigma_spread: float = 1.0
    corner_floor_px: float = 0.01
    focal_sigma: float = 0.003
    centre_sigma: float = 0.002
    distortion_sigma: float = 0.01
    nominal_focal_sigma: float = 0.05
    nominal_centre_sigma: float = 0.03
    nominal_distortion_sigma: float = 0.15
    edge_sigma_px: float = 0.03
    clock_sigma_s: float = 0.05
    row_time_sigma_s: float = 30e-6
    point_tilt_sigma_rad: float = 0.005
    wobble_sigma_rad: float = 0.004
    wobble_time_s: float = 0.5
    scale_sigma: float = 0.003
    robot_height_sigma_m: float = 0.001
    acceleration_sigma: float = 3.0
    turn_sigma: float = 10.0
    jerk_density: float = 3.0
    turn_jerk_density: float = 10.0
    stamp_jitter_s: float = 0.001
    follows_valleys: bool = True
