"""Least squares of a marker's pose: unknowns, derivatives of the edges, and the resulting outline.

The unknowns are a twist in print coordinates, the edge offset and, with a rolling shutter, the speed along
the print. The effect of rotation and translation is computed in the plane of the print, without lens
distortion. A point x of the plane moves by d. The camera at c then sees the point at
x + d_xy + (x - c)_xy d_z / c_z.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Grey
from ipsys_log.stages.detect.prints import MarkerView, Poses, Prints
from ipsys_log.stages.detect.uneven_light import CELL_SAMPLES
from ipsys_log.vision.decode import levels_at
from ipsys_log.vision.lenses import project

# Prior weights: squared pixels per squared unit of each unknown: translation and rotation, edge offset,
# speed. A marker directly below the camera has an unobservable tilt, which keeps its value.
_HOLD = np.array([1e-6, 1e-6, 1e-6, 1e-2, 1e-2, 1e-6, 1e-6, 1e-5, 1e-5])
_HOLD_GIVEN, _HOLD_SPEED = 1e9, 1e-1

_SHARP = np.zeros(2, dtype=bool)


class Guess(NamedTuple):
    """An approximate marker pose: ``rotation`` (3, 3) and ``centre`` (3,) map marker to camera coordinates.

    The unit of length is the side of its black square, because an image does not contain the scale.
    ``motion`` (3,) is its speed along its own x and y, in sides per s, and its rotation about its normal in
    rad/s. It is None if it is unknown. ``blurred`` (2,) says if its motion blurs edges across its x, and
    across its y.
    """

    id: int
    rotation: Array
    centre: Array
    motion: Array | None = None
    blurred: NDArray[np.bool_] = _SHARP


class MarkerFit(NamedTuple):
    """A marker's pose, its corners, and their covariance (8, 8) in the order x0 y0 .. x3 y3.

    ``edge_offset_px`` is the edge offset into the black, ``rms_px`` the RMS residual of the edges, and
    ``blur_px`` their blur. ``disturbed`` says that glare, a shadow or a cover may have moved some edges.
    """

    pose: Guess
    corners_px: Array
    covariance_px2: Array
    edge_offset_px: float
    rms_px: float
    blur_px: float
    disturbed: bool = False


def poses_of(guesses: Sequence[Guess]) -> Poses:
    """Return the poses of guesses as arrays."""
    return Poses(
        np.array([guess.rotation for guess in guesses]), np.array([guess.centre for guess in guesses])
    )


def solve(rows: Array, weights: Array, off_px: Array, known: Array, hold: Array) -> tuple[Array, Array]:
    """Return the normal matrices (m, u, u) and the unknowns (m, u) of least squares, for m markers."""
    weighted = rows * weights[:, None]
    normal = weighted @ rows.transpose(0, 2, 1)
    count = known.shape[1]
    normal.reshape(len(known), -1)[:, :: count + 1] += hold
    right = weighted @ off_px[..., None] + (hold * known)[..., None]
    return normal, np.asarray(np.linalg.solve(normal, right)[..., 0], dtype=np.float64)


def prior(guesses: Sequence[Guess], edge_offset_px: float | None) -> tuple[Array, Array]:
    """Return the prior of the unknowns and the rotation, (m, 10), and its weights, (m, 9)."""
    known, hold = np.zeros((len(guesses), 10)), np.tile(_HOLD, (len(guesses), 1))
    if edge_offset_px is not None:
        known[:, 6], hold[:, 6] = edge_offset_px, _HOLD_GIVEN
    for n, guess in enumerate(guesses):
        if guess.motion is not None:
            known[n, 7:], hold[n, 7:] = guess.motion, _HOLD_SPEED
    return known, hold


def edge_derivatives(prints: Prints, camera: Array, slopes: Array, late: Array, unknowns: int) -> Array:
    """Return the motion in the image of points on edges along their axis, in px per unit of an unknown.

    Parameters
    ----------
    camera : (m, 3), camera positions in print coordinates.
    slopes, late : (m, s), as in :class:`~ipsys_log.stages.detect.prints.EdgePositions`.

    Returns
    -------
    (m, u, s), for 7 or 9 unknowns u.
    """
    x, y, level = prints.points[..., 0], prints.points[..., 1], prints.along_x
    aside = (np.where(level, y - camera[:, 1:2], x - camera[:, :1]) / camera[:, 2:]) * slopes
    rows = np.empty((len(level), unknowns, level.shape[1]))
    np.multiply(slopes, level, out=rows[:, 1])
    np.subtract(slopes, rows[:, 1], out=rows[:, 0])
    rows[:, 2] = aside
    np.multiply(aside, y, out=rows[:, 3])
    np.multiply(aside, -x, out=rows[:, 4])
    np.multiply(slopes, prints.rotation_derivative, out=rows[:, 5])
    np.negative(prints.polarity, out=rows[:, 6])
    if unknowns > 7:
        np.multiply(late, level, out=rows[:, 8])
        np.subtract(late, rows[:, 8], out=rows[:, 7])
    return rows


def outline(view: MarkerView, poses: Poses) -> tuple[Array, Array, Array]:
    """Return the corners, their derivatives and the grey levels of the cells of m markers.

    Returns
    -------
    Corners (m, 4, 2) in px, their derivatives by a twist (m, 8, 6), and grey levels of cells (m, c).
    """
    points, count = view.prints.outline, len(poses.centres)
    px = project(poses.into_camera(points).reshape(-1, 3), view.lens).reshape(count, -1, 2)
    per_unit = np.stack([px[:, 4:8] - px[:, :4], px[:, 8:12] - px[:, :4]], axis=3) / view.prints.nudge
    x, y = points[:4].T
    camera = poses.camera_positions()
    aside = (points[:4] - camera[:, None, :2]) / camera[:, None, 2:]
    inplane = np.zeros((count, 4, 2, 6))
    inplane[:, :, 0, 0] = inplane[:, :, 1, 1] = 1.0
    inplane[..., 2], inplane[:, :, 0, 5], inplane[:, :, 1, 5] = aside, -y, x
    inplane[..., 3], inplane[..., 4] = aside * y[:, None], aside * -x[:, None]
    levels = levels_at(view.grey, *np.ascontiguousarray(px[:, 12:].transpose(2, 0, 1), dtype=np.float32))
    return px[:, :4], (per_unit @ inplane).reshape(count, 8, 6), levels


def sample_cells(view: MarkerView, pose: Guess) -> Array:
    """Return grey levels of the cells of one marker, (5, c): at the middle of each cell and around it."""
    prints = view.prints
    middles = prints.outline[12:]
    points = (middles + CELL_SAMPLES[:, None] / prints.cells).reshape(1, -1, 2)
    px = project(poses_of([pose]).into_camera(points).reshape(-1, 3), view.lens)
    levels = levels_at(view.grey, *np.ascontiguousarray(px.T, dtype=np.float32))
    return np.asarray(levels, dtype=np.float64).reshape(len(CELL_SAMPLES), -1)


def inside_image(corners_px: Array, grey: Grey) -> NDArray[np.bool_]:
    """Return a mask (m,) of the markers whose corners (m, 4, 2) are all inside the image."""
    last = np.array([grey.shape[1], grey.shape[0]]) - 0.5
    return np.asarray(((corners_px >= -0.5) & (corners_px <= last)).all(axis=(1, 2)))
