"""Lens distortion models: pixels to rays and back, horizontal planes, and intrinsics that no camera has."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError, SizeError
from ipsys_log.messages import CameraCalibration

# A ray that rises or falls by less than this per metre does not meet the floor in the field of view.
_LEAST_SLOPE = 1e-6


def intersect_height(
    origin_m: NDArray[np.float64], directions: NDArray[np.float64], heights_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the points at given heights on rays from one origin.

    Parameters
    ----------
    origin_m : (3,), in world m.
    directions : (n, 3), of any length.
    heights_m : (n,), the z of the points, in m.

    Returns
    -------
    (n, 3): world points in m; NaN if a ray is level or if its point is behind the origin.

    Examples
    --------
    >>> down = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    >>> intersect_height(np.array([0.0, 0.0, 2.0]), down, np.array([0.0, 0.5, 0.0])).tolist()
    [[0.0, 0.0, 0.0], [1.5, 0.0, 0.5], [nan, nan, nan]]
    """
    falls = directions[:, 2]
    slope = np.where(np.abs(falls) > _LEAST_SLOPE * np.linalg.norm(directions, axis=1), falls, np.nan)
    along = (heights_m - origin_m[2]) / slope
    along = np.where(along > 0, along, np.nan)
    points_m: NDArray[np.float64] = origin_m + along[:, None] * directions
    points_m[:, 2] = np.where(np.isnan(along), np.nan, heights_m)
    return points_m


# Names of Foxglove and ROS, with the number of coefficients of each model.
DISTORTION_MODELS = {"kannala_brandt": 4, "plumb_bob": 5, "rational_polynomial": 8}

# The inverse of a lens distortion has no closed form: the iteration continues far below the resolution of a
# log.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)

_LOST_PX = 0.01
_LARGEST = 1e9  # px, and a coefficient
_WIDEST_PX = 65_535
# Directions (u, v) nearer together than this are equal.
_SAME_RAY = 1e-3

# OpenCV 5 accepts the criteria in undistortPoints. OpenCV 4 has a separate function with criteria.
_undistort_pinhole = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


def check_calibration(lens: CameraCalibration, where: str) -> CameraCalibration:
    """Return ``lens`` if it is valid.

    Raises
    ------
    IpsysError
        The distortion model is unknown, the number of coefficients is wrong, or the values are not those of a
        camera with images of this size. The text names ``where``.
    """
    wanted = DISTORTION_MODELS.get(lens.distortion_model)
    if wanted is None:
        known = ", ".join(DISTORTION_MODELS)
        raise IpsysError(
            f"{where}: distortion model {lens.distortion_model!r} is not known (known are {known}). "
            f"{_advice(lens)}"
        )
    if lens.D.size != wanted:
        raise IpsysError(
            f"{where}: {lens.distortion_model} takes {wanted} coefficients, found {lens.D.size}. "
            f"{_advice(lens)}"
        )
    if not (np.abs(lens.K) <= _LARGEST).all() or not (np.abs(lens.D) <= _LARGEST).all():
        raise IpsysError(f"{where}: its matrix or coefficients are not valid; calibrate again")
    if not (0 < lens.width <= _WIDEST_PX and 0 < lens.height <= _WIDEST_PX):
        raise IpsysError(
            f"{where}: {lens.width} x {lens.height} px is not an image size; correct the size in pixels"
        )
    check_plausible(lens, where)
    return lens


def _advice(lens: CameraCalibration) -> str:
    """Return the advice for an invalid calibration."""
    name = lens.frame_id or "camera"
    option = f"--calibration {name}={name}.yaml"
    return f"Calibrate the camera with 'ipsys calibrate', and give the file with {option}"


def check_size(lens: CameraCalibration, width: int, height: int, camera: str | None) -> None:
    """Check that a calibration has the size of the frames of a camera."""
    if (lens.width, lens.height) != (width, height):
        raise SizeError(
            f"camera {camera}: its frames are {width} x {height} px, its calibration is for "
            f"{lens.width} x {lens.height}; calibrate at the size that is recorded, and give that with "
            f"--calibration {camera}=calibration.yaml"
        )


def scale_intrinsics(lens: CameraCalibration, width: int, height: int, where: str) -> CameraCalibration:
    """Return the calibration for images of another size with the same field of view.

    Examples
    --------
    >>> K = np.array([[1150.0, 0, 959.5], [0, 1150, 539.5], [0, 0, 1]])
    >>> lens = CameraCalibration(0, "red", 1920, 1080, "kannala_brandt", np.zeros(4), K)
    >>> scale_intrinsics(lens, 960, 540, "camera red").K.tolist()
    [[575.0, 0.0, 479.5], [0.0, 575.0, 269.5], [0.0, 0.0, 1.0]]
    """
    if (lens.width, lens.height) == (width, height):
        return lens
    if lens.width * height != lens.height * width:
        raise IpsysError(
            f"{where}: sends {width} x {height} px, but its calibration is for {lens.width} x {lens.height}, "
            "with another aspect ratio; calibrate at the recorded size"
        )
    scale = width / lens.width
    # (0, 0) is the centre of the first pixel, not its corner.
    matrix = np.diag([scale, scale, 1.0]) @ lens.K
    matrix[:2, 2] += (scale - 1) / 2
    P = np.hstack([matrix, np.zeros((3, 1))])
    return replace(lens, width=width, height=height, K=matrix, P=P)


def same_intrinsics(one: CameraCalibration, other: CameraCalibration) -> bool:
    """Return whether two calibrations map pixels to the same rays; times and frame ids may differ."""
    sizes = [(lens.width, lens.height, lens.distortion_model) for lens in (one, other)]
    return sizes[0] == sizes[1] and np.array_equal(one.K, other.K) and np.array_equal(one.D, other.D)


def undistort(points_px: NDArray[np.float64], lens: CameraCalibration) -> NDArray[np.float64]:
    """Return the normalized image coordinates (u, v) = (Xc / Zc, Yc / Zc) of pixels.

    Parameters
    ----------
    points_px : (n, 2), in px of the raw image.
    lens : the camera's calibration.

    Returns
    -------
    (n, 2), without unit; NaN if no ray of the lens meets the pixel, outside the calibrated area.

    References
    ----------
    Ou et al., Robotica 2023, sect. 2.1. Kannala and Brandt, PAMI 2006, for the fisheye model.

    Examples
    --------
    >>> from ipsys_log.vision.lenses import project
    >>> K = np.array([[1150.0, 0, 960], [0, 1150, 540], [0, 0, 1]])
    >>> P = np.hstack([K, np.zeros((3, 1))])
    >>> lens = CameraCalibration(0, "red", 1920, 1080, "kannala_brandt", np.zeros(4), K, np.eye(3), P)
    >>> point_px = project(np.array([[0.5, -0.25, 2.0]]), lens)
    >>> undistort(point_px, lens).round(9).tolist()
    [[0.25, -0.125]]
    """
    points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
    if not len(points):  # OpenCV refuses an empty array
        return np.zeros((0, 2))
    if lens.distortion_model == "kannala_brandt":
        uv = cv2.fisheye.undistortPoints(points, lens.K, lens.D, criteria=_CRITERIA)
    else:
        uv = _undistort_pinhole(points, lens.K, lens.D, R=np.eye(3), P=np.eye(3), criteria=_CRITERIA)
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    # OpenCV's iteration may end anywhere: if the result does not project to its pixel, it is no solution.
    again_px = _distort(uv, lens)
    lost = ~(np.abs(again_px - points.reshape(-1, 2)).max(axis=1, initial=0) < _LOST_PX)
    uv[lost] = np.nan
    return uv


def _distort(points_uv: NDArray[np.float64], lens: CameraCalibration) -> NDArray[np.float64]:
    """Return the pixels (n, 2) of normalized image coordinates (n, 2)."""
    if lens.distortion_model == "kannala_brandt":
        # The result is bit-identical to that of projectPoints, which also computes a Jacobian and takes 30
        # times as long.
        pixels = cv2.fisheye.distortPoints(points_uv.reshape(-1, 1, 2), lens.K, lens.D)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    return project(np.column_stack([points_uv, np.ones(len(points_uv))]), lens)


def project(points_m: NDArray[np.float64], lens: CameraCalibration) -> NDArray[np.float64]:
    """Return the pixels of points in camera coordinates.

    Parameters
    ----------
    points_m : (n, 3), in m, z > 0.
    lens : the camera's calibration.

    Returns
    -------
    (n, 2), in px of the raw image.
    """
    points = np.ascontiguousarray(points_m, dtype=np.float64).reshape(-1, 3)
    if not len(points):  # OpenCV refuses empty arrays
        return np.zeros((0, 2))
    if lens.distortion_model == "kannala_brandt":
        depths = points[:, 2:]
        if not depths.all():
            # projectPoints also does this.
            depths = np.where(depths == 0.0, 1.0, depths)
        return _distort(points[:, :2] / depths, lens)
    still = np.zeros(3)
    pixels, _ = cv2.projectPoints(points.reshape(-1, 1, 3), still, still, lens.K, lens.D)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def in_image(points_m: NDArray[np.float64], lens: CameraCalibration) -> NDArray[np.bool_]:
    """Return a mask (n,) of the points in camera coordinates that are visible in the image.

    Parameters
    ----------
    points_m : (n, 3), in m. A point that is NaN or not in front of the camera is not visible.
    lens : the camera's calibration.
    """
    inside = np.asarray(np.isfinite(points_m).all(axis=1) & (points_m[:, 2] > 0))
    if inside.any():
        px = project(points_m[inside], lens)
        framed = ((px >= 0) & (px <= [lens.width - 1, lens.height - 1])).all(axis=1)
        inside[inside] = framed
    if inside.any():
        # The distortion model can map a point outside the field of view into the image: it is not visible.
        again = undistort(px[framed], lens) - points_m[inside, :2] / points_m[inside, 2:]
        inside[inside] = np.abs(again).max(axis=1) < _SAME_RAY
    return inside


# The focal length as a share of the larger side of the image: the image circle of a lens of 220 degrees can
# fill half of the height (0.07), and a telescope has less than 1 degree (60).
_LEAST_FOCAL, _MOST_FOCAL = 0.05, 100.0
# fy / fx: images that are stretched from 16:9 to 4:3 have 1.33; half the rows have 2.
_UNUSUAL_RATIO, _MOST_RATIO = 1.4, 3.0
# A smaller skew moves no corner by more than the resolution of corners.
_MOST_SKEW_PX = 0.01
# The principal point as a share of the image: off the centre by more than this in both directions, and by the
# same share in both, is that of another image size. Lenses are off by less than 0.05.
_OFF_CENTRE, _SAME_SHARE = 0.09, 0.03
_FAR_CENTRE = 0.2
# The share of the image without rays because the lens curve turns back. Without boards in the corners of the
# images, honest calibrations lose the corners.
_FEW_LOST, _MOST_LOST = 0.01, 0.15
_WIDEST_TURN_RAD = np.radians(70.0)


def check_plausible(lens: CameraCalibration, where: str) -> None:
    """Check that finite intrinsics of a known model are those of a camera with images of this size.

    Raises
    ------
    IpsysError
        The camera matrix has another form or another unit, its principal point is that of another image size,
        or the lens curve turns back inside the image. The text names ``where``.
    """
    _check_matrix(lens, where)
    _check_centre(lens, where)
    lost = lost_share(lens)
    if lost > _MOST_LOST:
        raise IpsysError(
            f"{where}: the lens curve turns back inside the image: {100 * lost:.0f} % of the pixels have no "
            "ray; calibrate again, with the board in the corners of the image"
        )


def _check_matrix(lens: CameraCalibration, where: str) -> None:
    """Check that a camera matrix has the form fx 0 cx, 0 fy cy, 0 0 1, in pixels."""
    (fx, skew, cx), (lower, fy, cy), last = lens.K.tolist()
    fault, advice = "", "calibrate again"
    if last[:2] != [0, 0] and (cx, cy) == (0, 0):
        fault, advice = "is transposed: the principal point is in its last row", "exchange rows and columns"
    elif last != [0, 0, 1] or lower:
        text = f"its last row is {last}" if last != [0, 0, 1] else f"K[1, 0] is {lower:g}"
        fault, advice = (
            f"is not in the form fx 0 cx, 0 fy cy, 0 0 1: {text}",
            "correct the order of its numbers",
        )
    elif not fx > 0 < fy:
        fault = "has no positive focal lengths"
    elif not _LEAST_FOCAL <= min(fx, fy) / max(lens.width, lens.height) <= _MOST_FOCAL:
        fault = (
            f"has focal lengths of {fx:g} and {fy:g}, which are not those of {lens.width} x {lens.height} px"
        )
        advice = "give them in pixels"
    elif max(fx, fy) > _MOST_RATIO * min(fx, fy):
        fault = f"has pixels that are not square: fx is {fx:g} px, fy {fy:g} px"
    elif abs(skew) > _MOST_SKEW_PX:
        fault, advice = f"has a skew of {skew:g} px, which is not used", "calibrate again without a skew"
    if fault:
        raise IpsysError(f"{where}: the camera matrix K {fault}; {advice}")


def _check_centre(lens: CameraCalibration, where: str) -> None:
    """Check that the principal point is that of an image of this size."""
    centre_px, size_px = lens.K[:2, 2], np.array([lens.width, lens.height])
    shares = centre_px / size_px
    advice = "calibrate at the size of the recorded images, or correct image_width and image_height"
    point = f"{where}: the principal point ({centre_px[0]:.1f}, {centre_px[1]:.1f}) px is"
    size = f"images of {lens.width} x {lens.height} px"
    exchanged = np.abs(centre_px / size_px[::-1] - 0.5)
    if (np.abs(shares - 0.5) > _OFF_CENTRE).all():
        if (exchanged < _OFF_CENTRE / 2).all():
            raise IpsysError(
                f"{point} that of images of {lens.height} x {lens.width} px, not of {size}; exchange "
                "width and height"
            )
        if abs(shares[0] - shares[1]) < _SAME_SHARE:
            other = np.round(size_px * shares.mean() * 2).astype(int)
            raise IpsysError(
                f"{point} that of images of about {other[0]} x {other[1]} px, not of {size}; {advice}"
            )
    if not ((shares > 0) & (shares < 1)).all():
        raise IpsysError(f"{point} outside {size}; {advice}")


def calibration_remarks(lens: CameraCalibration) -> list[str]:
    """Return remarks on a valid calibration whose values are unusual."""
    remarks = []
    shares = lens.K[:2, 2] / [lens.width, lens.height]
    if (np.abs(shares - 0.5) > _FAR_CENTRE).any():
        remarks.append(
            f"the principal point ({lens.K[0, 2]:.1f}, {lens.K[1, 2]:.1f}) px is far from the centre of "
            f"{lens.width} x {lens.height} px; check that the calibration is for images of this size"
        )
    lost = lost_share(lens)
    if lost > _FEW_LOST:
        remarks.append(
            f"the lens curve turns back in the corners of the image: {100 * lost:.1f} % of the pixels have "
            "no ray; calibrate with the board in the corners"
        )
    fx, fy = lens.K[0, 0], lens.K[1, 1]
    if max(fx, fy) > _UNUSUAL_RATIO * min(fx, fy):
        remarks.append(f"its pixels are not square: fx is {fx:g} px, fy {fy:g} px; check the image size")
    return remarks


def lost_share(lens: CameraCalibration) -> float:
    """Return the share of the pixels outside the radius at which the lens curve turns back, 0 to 1.

    The curve is that of the distorted over the undistorted distance from the axis, up to 70 degrees. A pixel
    outside has no ray, or one of the wrong branch. Wider rays of a fisheye can end in a black border.
    """
    angles = np.linspace(0, _WIDEST_TURN_RAD, 2000)
    if lens.distortion_model == "kannala_brandt":
        radii = angles * np.polynomial.polynomial.polyval(angles**2, [1.0, *lens.D])
    else:
        k1, k2, k3, k4, k5, k6 = np.pad(lens.D, (0, 8 - lens.D.size))[[0, 1, 4, 5, 6, 7]]
        squares = np.tan(angles) ** 2
        numerator, denominator = (
            np.polynomial.polynomial.polyval(squares, [1.0, *terms]) for terms in ((k1, k2, k3), (k4, k5, k6))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            radii = np.tan(angles) * numerator / denominator
    falls = np.flatnonzero(~(np.diff(radii) > 0))
    if not len(falls):
        return 0.0
    columns = (np.linspace(0, lens.width - 1, 65) - lens.K[0, 2]) / lens.K[0, 0]
    rows = (np.linspace(0, lens.height - 1, 65) - lens.K[1, 2]) / lens.K[1, 1]
    return float((np.hypot(columns, rows[:, None]) > radii[falls[0]]).mean())
