"""Lens models of the calibration: pixels of points, with derivatives; nominal intrinsics of a data sheet.

The intrinsic parameters are one row: fx, fy, cx, cy in px, then the coefficients in the order of OpenCV.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration

# Least depth of a point for a pinhole model, as a share of its distance. Other points have no image.
_LEAST_DEPTH = 1e-3
_TINY = 1e-12
# The prior is much weaker than the corners, but enough if the corners give no information.
_PULL_PX = 0.1


class LensModel(NamedTuple):
    """A lens model: its name in the log, its coefficient names, and the number of fitted coefficients.

    The other coefficients stay 0. ``distort`` returns the image of points at a focal length of 1,
    ``distort_with_slopes`` also its derivatives. ``usual`` is the usual size of coefficients that
    images may not determine separately: a common factor of numerator and denominator has no effect.
    """

    distortion_model: str
    coefficients: tuple[str, ...]
    fitted: int
    distort: Callable[[Array, Array], Array]
    distort_with_slopes: Callable[[Array, Array], tuple[Array, Array, Array]]
    usual: float = np.inf

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all parameters, in order."""
        return ("fx", "fy", "cx", "cy", *self.coefficients)

    @property
    def pull(self) -> Array:
        """The weight of the prior that draws each parameter to 0, (p,).

        A coefficient of the usual size costs the square of a residual of ``_PULL_PX``.
        """
        strength = (_PULL_PX / self.usual) ** 2
        return np.array([0.0] * 4 + [strength] * len(self.coefficients))


def project_points(model: LensModel, parameters: Array, points_m: Array) -> Array:
    """Return the pixels of points, (n, 2).

    Parameters
    ----------
    model : the lens model.
    parameters : (p,), in the order of ``model.names``.
    points_m : (n, 3), in camera coordinates; for a fisheye also beside and behind the camera.
    """
    return np.asarray(model.distort(points_m, parameters[4:]) * parameters[:2] + parameters[2:4])


def project_with_slopes(model: LensModel, parameters: Array, points_m: Array) -> tuple[Array, Array, Array]:
    """Return the pixels of points, and their derivatives by the point and by the intrinsic parameters.

    Returns
    -------
    Pixels (n, 2), their derivatives by the point (n, 2, 3), in px/m, and by the parameters (n, 2, p).
    """
    distorted, by_point, by_coefficients = model.distort_with_slopes(points_m, parameters[4:])
    focal_px = parameters[:2]
    by_parameters = np.zeros((len(points_m), 2, parameters.size))
    by_parameters[:, 0, 0], by_parameters[:, 1, 1] = distorted.T
    by_parameters[:, 0, 2] = by_parameters[:, 1, 3] = 1.0
    by_parameters[:, :, 4:] = by_coefficients * focal_px[:, None]
    return distorted * focal_px + parameters[2:4], by_point * focal_px[:, None], by_parameters


def _fisheye_angle(points_m: Array) -> tuple[Array, Array, Array, Array]:
    """Return the squared length of points, their distance from the axis, the angle, and its square."""
    x, y, z = points_m.T
    square = x * x + y * y + z * z
    r = np.maximum(np.hypot(x, y), 1e-9 * np.sqrt(square))
    theta = np.arctan2(r, z)
    return square, r, theta, theta * theta


def _distort_fisheye(points_m: Array, k: Array) -> Array:
    """Apply the model of Kannala and Brandt (PAMI 2006) in OpenCV's form: it distorts the angle to the axis.

    The angle is atan2(r, z), so that it may exceed 90 degrees.
    """
    _, r, theta, t2 = _fisheye_angle(points_m)
    distorted = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    return np.asarray(points_m[:, :2] * (distorted / r)[:, None])


def _distort_fisheye_with_slopes(points_m: Array, k: Array) -> tuple[Array, Array, Array]:
    """Return the result of ``_distort_fisheye``, and its derivatives by the point and by the coefficients."""
    square, r, theta, t2 = _fisheye_angle(points_m)
    distorted = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
    scale = distorted / r
    # d scale / d (x, y, z), of distorted(theta(r, z)) / r(x, y).
    x, y, z = points_m.T
    along_r = (slope * z / square - scale) / r**2
    by_scale = np.stack([along_r * x, along_r * y, -slope / square], axis=1)
    planar = points_m[:, :2]
    by_point = planar[:, :, None] * by_scale[:, None, :]
    by_point[:, 0, 0] += scale
    by_point[:, 1, 1] += scale
    by_k = np.empty((len(points_m), 2, 4))
    step = planar * (theta / r)[:, None]
    for n in range(4):
        step = step * t2[:, None]
        by_k[:, :, n] = step
    return planar * scale[:, None], by_point, by_k


def _planar(points_m: Array) -> tuple[Array, Array]:
    """Return points in the plane at depth 1, (2, n), and their original depths (n,)."""
    x, y, z = points_m.T
    depth_m = np.maximum(z, _LEAST_DEPTH * np.sqrt(x * x + y * y + z * z) + _TINY)
    return np.stack([x / depth_m, y / depth_m]), depth_m


def _eight(k: Array) -> list[float]:
    return [*k.tolist(), *[0.0] * (8 - k.size)]


def _distort_pinhole(points_m: Array, k: Array) -> Array:
    """Apply Brown's radial and tangential terms in OpenCV's form: k1 k2 p1 p2 k3, and a divisor k4 k5 k6."""
    (a, b), _ = _planar(points_m)
    k1, k2, p1, p2, k3, k4, k5, k6 = _eight(k)
    r2 = a * a + b * b
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    distorted = np.empty((len(points_m), 2))
    distorted[:, 0] = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    distorted[:, 1] = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    return distorted


def _distort_pinhole_with_slopes(points_m: Array, k: Array) -> tuple[Array, Array, Array]:
    """Return the result of ``_distort_pinhole``, and its derivatives by the point and by the coefficients."""
    (a, b), depth_m = _planar(points_m)
    k1, k2, p1, p2, k3, k4, k5, k6 = _eight(k)
    r2, two_ab = a * a + b * b, 2 * a * b
    bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / bottom
    climb = k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
    slope = 2 * climb / bottom
    of_p1, of_p2 = r2 + 2 * b * b, r2 + 2 * a * a
    distorted = np.empty((len(points_m), 2))
    distorted[:, 0] = a * radial + p1 * two_ab + p2 * of_p2
    distorted[:, 1] = b * radial + p1 * of_p1 + p2 * two_ab
    by_point = np.empty((len(points_m), 2, 3))
    by_point[:, 0, 0] = a * a * slope + radial + 2 * p1 * b + 6 * p2 * a
    by_point[:, 1, 1] = b * b * slope + radial + 6 * p1 * b + 2 * p2 * a
    by_point[:, 0, 1] = by_point[:, 1, 0] = a * b * slope + 2 * p1 * a + 2 * p2 * b
    by_point[:, :, 2] = -(by_point[:, :, 0] * a[:, None] + by_point[:, :, 1] * b[:, None])
    by_point /= depth_m[:, None, None]
    by_k = np.empty((len(points_m), 2, 8))
    for axis, along in enumerate((a, b)):
        rise = along / bottom
        # k1 k2 k3 in the numerator, k4 k5 k6 in the denominator.
        for above, below in ((0, 5), (1, 6), (4, 7)):
            rise = rise * r2
            by_k[:, axis, above], by_k[:, axis, below] = rise, -rise * radial
    by_k[:, 0, 2], by_k[:, 0, 3] = two_ab, of_p2
    by_k[:, 1, 2], by_k[:, 1, 3] = of_p1, two_ab
    return distorted, by_point, by_k[:, :, : k.size]


_FISHEYE = (_distort_fisheye, _distort_fisheye_with_slopes)
_PINHOLE = (_distort_pinhole, _distort_pinhole_with_slopes)
_FIVE = ("k1", "k2", "p1", "p2", "k3")

# The lens models by their name in the option --lens.
LENS_MODELS = {
    "fisheye": LensModel("kannala_brandt", ("k1", "k2", "k3", "k4"), 4, *_FISHEYE),
    "pinhole": LensModel("plumb_bob", _FIVE, 5, *_PINHOLE),
    "pinhole4": LensModel("plumb_bob", _FIVE, 4, *_PINHOLE),
    "pinhole8": LensModel("rational_polynomial", (*_FIVE, "k4", "k5", "k6"), 8, *_PINHOLE, 2.0),
}


def find_lens_model(name: str) -> LensModel:
    """Return the lens model with a name."""
    if name not in LENS_MODELS:
        raise IpsysError(f"--lens {name}: is not known; use one of {', '.join(LENS_MODELS)}")
    return LENS_MODELS[name]


# Lenses with a smaller horizontal field of view keep straight lines straight; wider ones are fisheye lenses.
_STRAIGHT_RAD = math.radians(100)
_WIDEST_RAD = math.radians(220)


def nominal_intrinsics(
    camera: str,
    size_px: tuple[int, int],
    focal_px: float | None = None,
    field_of_view_rad: float | None = None,
) -> CameraCalibration:
    """Return intrinsics without lens distortion, with the principal point in the middle of the image.

    Parameters
    ----------
    camera : its name.
    size_px : width and height of the images.
    focal_px : focal length; None to compute it from the field of view.
    field_of_view_rad : horizontal field of view. Below 100 degrees, it is that of a lens that keeps straight
        lines straight, otherwise that of a fisheye lens.

    Examples
    --------
    >>> nominal_intrinsics("red", (1920, 1080), field_of_view_rad=np.pi / 2).K[0, 0].round(3)
    np.float64(960.0)
    """
    width, height = size_px
    if focal_px is None:
        angle_rad = field_of_view_rad
        if angle_rad is None or not 0 < angle_rad <= _WIDEST_RAD:
            degrees = "none" if angle_rad is None else f"{math.degrees(angle_rad):g} degrees"
            raise IpsysError(
                f"camera {camera}: the field of view is {degrees}; give degrees above 0 and up to 220"
            )
        half_rad = angle_rad / 2
        focal_px = width / 2 / (math.tan(half_rad) if angle_rad < _STRAIGHT_RAD else half_rad)
    if not width / 10 <= focal_px <= 100 * width:
        raise IpsysError(
            f"camera {camera}: a focal length of {focal_px:g} px is impossible for a width of {width} px; "
            "give the focal length in pixels"
        )
    K = np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
    P = np.hstack([K, np.zeros((3, 1))])
    return CameraCalibration(0, camera, width, height, "kannala_brandt", np.zeros(4), K, np.eye(3), P)
