"""Nominal camera intrinsics, from a data sheet instead of a chessboard."""

from __future__ import annotations

import math

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration

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

    Raises
    ------
    IpsysError
        Neither is given, or a value is impossible.

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
