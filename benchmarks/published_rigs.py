"""Cameras of rigs that others made and published: their intrinsics and poses, above the floor of a lab.

The floor of 4.88 m is put where most of the cameras look. Robots, markers and clocks are simulated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ipsys_log.capture.simulation.cameras import Camera
from ipsys_log.messages import CameraCalibration
from ipsys_log.vision.poses import make_pose


@dataclass(frozen=True)
class PublishedRig:
    """A rig: image size, place of the floor's corner in its world in m, sides of the robots' markers in m.

    ``cameras`` have fx, fy, cx, cy, then k1, k2, p1, p2, then the turn and the position in m. The turn is
    roll, pitch and yaw of the camera in the world, or the rotation matrix from the world to the camera, row
    by row; the matrix goes with the translation to camera coordinates.
    """

    size_px: tuple[int, int]
    corner_m: tuple[float, float]
    marker_length_m: float
    cameras: tuple[tuple[float, ...], ...]

    def place_cameras(self) -> tuple[Camera, ...]:
        """Return the cameras in the world of the lab."""
        return tuple(self._place(number, values) for number, values in enumerate(self.cameras))

    def _place(self, number: int, values: tuple[float, ...]) -> Camera:
        fx, fy, cx, cy, *distortion = values[:8]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        turn, position_m = np.array(values[8:-3]), np.array(values[-3:])
        if len(turn) == 3:
            turned = Rotation.from_euler("xyz", turn).as_matrix().T
            origin_m = position_m
        else:
            turned = turn.reshape(3, 3)
            origin_m = -turned.T @ position_m
        origin_m = origin_m - [*self.corner_m, 0.0]
        name, P = f"camera{number}", np.hstack([K, np.zeros((3, 1))])
        lens = CameraCalibration(0, name, *self.size_px, "plumb_bob", np.array([*distortion, 0.0]), K, P=P)
        return Camera(name, lens, make_pose(turned, -turned @ origin_m))


# Five ceiling cameras of the robot lab of Worcester Polytechnic Institute, which detect AR markers:
# https://github.com/GT-RAIL/rail_ceiling (BSD), config/camera_info and urdf/ceiling.urdf.xacro.
_RAIL = PublishedRig(
    (1920, 1080),
    (1.1, -0.3),
    0.20,
    (
        (
            *(1473.735, 1452.193, 802.714, 442.730, -0.01268, 0.01747, -0.00621, -0.00475),
            *(3.13726, -0.155766, -3.12692, 4.81422, 0.496356, 2.72483),
        ),
        (
            *(1588.952, 1604.060, 1042.322, 517.206, 0.00137, 0.11172, -0.00941, 0.01535),
            *(2.993, -0.0794397, 1.59787, 2.6261, 0.83305, 2.9213),
        ),
        (
            *(1451.015, 1447.507, 936.985, 568.619, -0.08948, 0.08776, -0.00024, -0.00405),
            *(-3.12482, 0.0176431, -1.59749, 4.30915, 2.07388, 2.6934),
        ),
        (
            *(1568.219, 1568.695, 894.088, 609.492, -0.05980, 0.07458, 0.01427, -0.01287),
            *(-3.02988, -0.175625, -1.56704, 2.40755, 2.69795, 2.86367),
        ),
        (
            *(1530.582, 1537.434, 969.151, 586.542, -0.03538, 0.04157, 0.00453, -0.00406),
            *(3.12016, 0.0540734, 3.12856, 4.36106, 3.56552, 2.88649),
        ),
    ),
)
# Four cameras in the corners of a room, with tilts of 49 to 55 degrees: ICG Lab 6 of Graz University of
# Technology (Possegger et al., CVPR 2013), from data/icglab6 of https://github.com/lacatus/TFM (Apache 2.0).
_ICG = PublishedRig(
    (1024, 768),
    (-2.9, -2.9),
    0.35,
    (
        (
            *(912.644, 912.644, 533.218, 474.968, 0.0, 0.0, 0.0, 0.0),
            *(-0.276801, 0.960818, -0.014483, 0.557930, 0.148426, -0.816507, -0.782365, -0.234091, -0.577154),
            *(1.34986649, -1.05576925, 6.55264379),
        ),
        (
            *(886.444, 886.444, 514.282, 506.210, 0.0, 0.0, 0.0, 0.0),
            *(-0.870108, -0.480244, 0.110804, -0.380468, 0.511582, -0.770408, 0.313298, -0.712496, -0.627849),
            *(-0.96150744, 0.29687755, 4.07633994),
        ),
        (
            *(870.716, 870.716, 545.552, 506.632, 0.0, 0.0, 0.0, 0.0),
            *(-0.149743, -0.988625, 0.014082, -0.651863, 0.088007, -0.753213, 0.743406, -0.121968, -0.657626),
            *(-1.40987888, -0.68159752, 5.16431115),
        ),
        (
            *(874.403, 874.403, 541.101, 474.339, 0.0, 0.0, 0.0, 0.0),
            *(0.907964, -0.412827, -0.071942, -0.310650, -0.547876, -0.776742, 0.281245, 0.727603, -0.625696),
            *(-0.85523994, -0.40350831, 5.27913213),
        ),
    ),
)
RIGS = {"RAIL": _RAIL, "ICG": _ICG}
