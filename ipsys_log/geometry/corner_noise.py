"""The noise of a marker's corners, and what the lens makes of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import project
from ipsys_log.messages import CameraCalibration

__all__ = ["check_covariance", "pixel_slopes", "whiten"]

Array = NDArray[np.float64]

# About a tenth of a pixel: what the third derivative of a lens adds is below 1e-7 of the slope.
_STEP = 1e-4
_STEPS = _STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
# A covariance of less than full rank has variances of 1e-7 of the largest one, of either sign, in the
# directions in which it has none: it is stored in single precision.
_NO_VARIANCE = 1e-4


def check_covariance(covariance_px2: Array, where: str) -> None:
    """See that a covariance can be computed with, whatever its rank.

    Raises
    ------
    IpsysError
        Naming ``where``, for a matrix that is no covariance.
    """
    if not (np.isfinite(covariance_px2).all() and np.trace(covariance_px2) > 0):
        raise IpsysError(f"{where}: covariance_px2 has no variance in it; detect the markers again")


def pixel_slopes(uv: Array, lens: CameraCalibration) -> Array:
    """By how many px a point moves in the raw image as its normalized coordinates change.

    Parameters
    ----------
    uv : (n, 2), normalized image coordinates.
    lens : the camera's calibration.

    Returns
    -------
    (n, 2, 2): rows x and y in px, columns u and v.

    Examples
    --------
    >>> K = np.array([[1150.0, 0, 960], [0, 1140, 540], [0, 0, 1]])
    >>> lens = CameraCalibration(0, "red", 1920, 1080, "plumb_bob", np.zeros(5), K)
    >>> pixel_slopes(np.array([[0.3, 0.1]]), lens).round(3).tolist()
    [[[1150.0, 0.0], [0.0, 1140.0]]]
    """
    around = np.ones((len(uv), 4, 3))
    around[..., :2] = uv[:, None] + _STEPS
    seen_px = project(around.reshape(-1, 3), lens).reshape(-1, 4, 2)
    slopes: Array = (seen_px[:, ::2] - seen_px[:, 1::2]).swapaxes(1, 2)
    return slopes / (2 * _STEP)


def whiten(covariances_px2: Array) -> Array:
    """What turns a marker's corners into eight numbers of variance 1, independent of each other.

    A pose that was fitted to an image gives corners of rank 6: what the noise did in the other two of
    their eight directions, the fit has taken away. Just these two tell one pose from another, so they must
    weigh neither nothing, nor as if they had been measured without noise. They had the noise of the others
    before the fit, and are given the mean variance of those.

    Parameters
    ----------
    covariances_px2 : (n, 8, 8), of x0 y0 .. x3 y3, in px^2 (see :func:`check_covariance`).

    Returns
    -------
    (n, 8, 8), in 1 / px.

    Examples
    --------
    >>> np.abs(whiten(np.diag([0.04] * 6 + [0.0, 0.0])[None])).sum(axis=1).round(9).tolist()
    [[5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0]]
    """
    found, axes = np.linalg.eigh(covariances_px2)
    has = found > _NO_VARIANCE * found[:, -1:]
    means = (found * has).sum(axis=1) / has.sum(axis=1)
    filled = np.where(has, found, means[:, None])
    whitening: Array = axes.swapaxes(1, 2) / np.sqrt(filled)[..., None]
    return whitening
