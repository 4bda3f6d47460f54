"""Synthetic markers with known lenses: corners by OpenCV's projection, rotations by SciPy."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.messages import CameraCalibration

Array = NDArray[np.float64]

COEFFICIENTS = {
    "kannala_brandt": (-0.1305, 0.0119, -0.0310, 0.0168),
    "plumb_bob": (-0.33, 0.046, -0.0043, 0.0041, 0.0666),
    "rational_polynomial": (0.2, 0.05, 0.001, -0.002, 0.01, 0.3, 0.04, 0.002),
}
K = np.array([[1151.6, 0, 932.9], [0, 1148.8, 504.3], [0, 0, 1]])
LENSES = {
    model: CameraCalibration(0, "red", 1920, 1080, model, np.array(d), K) for model, d in COEFFICIENTS.items()
}
FISHEYE = LENSES["kannala_brandt"]
LENGTH_M = 0.2
# Points 2.1 m below the camera: at the image centre, half-way out, and at the image edge.
CENTRE, MIDWAY, EDGE = (0.02, -0.03, 2.1), (1.0, 0.5, 2.1), (2.4, 0.1, 2.1)


def turned(heading_rad: float, tilt_deg: float = 0.0, about_rad: float = 0.0) -> Array:
    """Return the axes of a marker that faces the camera, tilted about a line in the image plane."""
    along = np.array([np.cos(about_rad), np.sin(about_rad), 0.0])
    tilt = Rotation.from_rotvec(np.deg2rad(tilt_deg) * along)
    # The y axis has the direction of the heading, which is minus the angle in the image.
    facing = Rotation.from_euler("z", np.pi / 2 - heading_rad) * Rotation.from_euler("x", np.pi)
    return np.asarray((tilt * facing).as_matrix())


def corners_px(lens: CameraCalibration, axes: Array, centre_m: Array, length_m: float = LENGTH_M) -> Array:
    """Return the corners (4, 2) in a perfect camera, in pixels."""
    half = length_m / 2
    square = np.array([[[-half, half, 0]], [[half, half, 0]], [[half, -half, 0]], [[-half, -half, 0]]])
    vector, shift = cv2.Rodrigues(axes)[0], np.asarray(centre_m, dtype=np.float64)
    project = cv2.fisheye.projectPoints if lens.distortion_model == "kannala_brandt" else cv2.projectPoints
    return np.asarray(project(square, vector, shift, lens.K, lens.D)[0], dtype=np.float64).reshape(4, 2)


def random_poses(
    count: int, rng: np.random.Generator, lens: CameraCalibration, length_m: float = LENGTH_M
) -> tuple[Array, Array, Array]:
    """Return markers all over the image, with tilts of 0 to 5 degrees and a camera tilt of 0.5 to 2 degrees.

    The result has axes (n, 3, 3), centres (n, 3) in m and corners (n, 4, 2) in px.
    """
    found: list[tuple[Array, Array, Array]] = []
    while len(found) < count:
        # The lenses with pixel coefficients end inside the image.
        reach = (2.6, 1.3) if lens is FISHEYE else (1.3, 0.7)
        centre_m = np.array([*rng.uniform(-1, 1, 2) * reach, rng.uniform(1.9, 2.1)])
        marker = turned(rng.uniform(-3, 3), rng.uniform(0, 5), rng.uniform(0, 2 * np.pi))
        about_rad = rng.uniform(0, 2 * np.pi)
        camera = rng.uniform(0.5, 2) * np.pi / 180 * np.array([np.cos(about_rad), np.sin(about_rad), 0])
        axes = Rotation.from_rotvec(camera).as_matrix() @ marker
        seen_px = corners_px(lens, axes, centre_m, length_m)
        if (seen_px > 0).all() and (seen_px < (lens.width - 1, lens.height - 1)).all():
            found.append((axes, centre_m, seen_px))
    axes, centres_m, seen = (np.stack(values) for values in zip(*found, strict=True))
    return axes, centres_m, seen
