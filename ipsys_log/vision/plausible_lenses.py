"""Values of camera intrinsics that no camera has, or that are unusual."""

from __future__ import annotations

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration

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
