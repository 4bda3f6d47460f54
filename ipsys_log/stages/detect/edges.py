"""Corners from the edges of a marker: its pose is moved until the print lies on the picture.

From an approximate pose, points on all edges between black and white of the known print, the inner ones
too, are sent through the lens into the picture. Across each edge a short profile of grey levels is read, and
a blurred step is fitted to it: how far it lies beside the middle is how far the edge is off. One small turn
and shift of the marker explains all of them at once; the next pass starts from there, until nothing moves.

What a turn and shift do is reckoned in the plane of the print, where it needs no lens: a point x of the plane
that moves by d is seen, from the camera at c, at x + d_xy + (x - c)_xy d_z / c_z.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ipsys_log.geometry.lenses import project
from ipsys_log.geometry.poses import rotation
from ipsys_log.messages import CameraCalibration
from ipsys_log.stages.detect.decode import Grey, levels_at
from ipsys_log.stages.detect.prints import Prints, lay_out

__all__ = ["Fit", "Guess", "fit_edges"]

Array = NDArray[np.float64]

# Profiles reach this far to each side, and never to the middle of a cell.
_NEAR_PX, _FAR_PX, _OF_CELL = 3.0, 8.0, 0.45
_TAPS = np.linspace(-1, 1, 7)
# Of the blurred step: what optics, pixels and JPEG do.
_BLUR_PX = 0.8
_MOVED_FAR_PX = 1.0
_PASSES = 7
# The last step of a fit that has settled is shorter.
_SETTLED_PX = 0.12
# Edges of less than this share of the mean contrast are covered, or in glare.
_WEAK = 0.3
_SEEN = 0.6
_EXACT_PX = 0.05
_LEAST_CONTRAST = 8.0
_WRONG_CELLS = 1
# Squared pixels per squared unit of each unknown that hold it to its guess. A tilt that shows in nothing,
# of a marker right below the camera, stays what it is.
_HOLD = np.diag([1e-6, 1e-6, 1e-6, 1e-2, 1e-2, 1e-6, 1e-6])


class Guess(NamedTuple):
    """About where a marker is: ``rotation`` (3, 3) and ``centre`` (3,) take its frame to the camera's.

    Lengths are in sides of its black square, whatever that measures: a picture does not say."""

    id: int
    rotation: Array
    centre: Array


class Fit(NamedTuple):
    """Where a marker is, with the covariance (8, 8) of its corners x0 y0 .. x3 y3, and by how much edges of
    black lie inside the black."""

    pose: Guess
    corners_px: Array
    covariance_px2: Array
    edge_offset_px: float


def fit_edges(
    grey: Grey,
    guesses: Sequence[Guess],
    dictionary: str,
    lens: CameraCalibration,
    edge_offset_px: float | None = None,
) -> list[Fit | None]:
    """Fit markers to the picture of them.

    Parameters
    ----------
    grey : (height, width).
    guesses : markers and about where they are, to some pixels.
    dictionary : OpenCV's name, such as DICT_4X4_100.
    lens : of the camera.
    edge_offset_px : by how much edges of black lie inside the black; None: found with each marker.

    Returns
    -------
    For each guess the fit, or None where there is no such marker: the fit does not settle, edges are
    missing, a corner lies outside of the picture, or the cells are not those of this id.
    """
    if not guesses:
        return []
    prints = lay_out(dictionary, tuple(guess.id for guess in guesses))
    poses = _Poses(
        np.array([guess.rotation for guess in guesses]),
        np.array([guess.centre for guess in guesses]),
    )
    settled = _settle(grey, prints, poses, lens, edge_offset_px)
    corners_px, cornerwise, cells_px = _outline(settled.poses, prints, lens)
    good = settled.good & _whole(corners_px, grey) & _same_cells(_cells(grey, cells_px), prints.white)
    covariances_px2 = cornerwise @ settled.covariances @ cornerwise.transpose(0, 2, 1)
    return [
        Fit(
            Guess(guess.id, settled.poses.rotations[n], settled.poses.centres[n]),
            corners_px[n],
            covariances_px2[n],
            float(settled.edge_offsets_px[n]),
        )
        if good[n]
        else None
        for n, guess in enumerate(guesses)
    ]


class _Poses(NamedTuple):
    """Of m markers: (m, 3, 3) and (m, 3)."""

    rotations: Array
    centres: Array

    def into_camera(self, points: Array) -> Array:
        """Points of prints, (m, n, 2), in the frame of the camera: (m, n, 3)."""
        return points @ self.rotations[:, :, :2].transpose(0, 2, 1) + self.centres[:, None]

    def camera(self) -> Array:
        """Where the camera is in the frames of the prints: (m, 3)."""
        return -(self.centres[:, None] @ self.rotations)[:, 0]

    def moved(self, twists: Array) -> _Poses:
        """Shifted and turned by (m, 6), in the frames of the prints."""
        shifts = (self.rotations @ twists[:, :3, None])[..., 0]
        turns = np.array([rotation(vector) for vector in twists[:, 3:]])
        return _Poses(self.rotations @ turns, self.centres + shifts)


class _Settled(NamedTuple):
    """Fitted poses; ``covariances`` (m, 6, 6) of the twists in the frames of the prints."""

    poses: _Poses
    edge_offsets_px: Array
    covariances: Array
    good: NDArray[np.bool_]


def _settle(
    grey: Grey, prints: Prints, poses: _Poses, lens: CameraCalibration, edge_offset_px: float | None
) -> _Settled:
    unknowns = 7 if edge_offset_px is None else 6
    hold = _HOLD[:unknowns, :unknowns]
    far = np.zeros(len(poses.centres), dtype=bool)
    doubt: Array | float = 1.0
    for _ in range(_PASSES):
        off_px, slopes, present = _measure(grey, prints, poses, lens, far)
        if edge_offset_px is not None:
            off_px = off_px + edge_offset_px * prints.polarity
        weights = present / doubt
        count = weights.sum(axis=1)
        rows = _moves(prints, poses.camera(), slopes)[:, :unknowns]
        weighted = rows * weights[:, None]
        normal = weighted @ rows.transpose(0, 2, 1) + hold
        steps = np.linalg.solve(normal, weighted @ off_px[..., None])[..., 0]
        steps_px = (steps[:, None, :6] @ rows[:, :6])[:, 0]
        moved_px = np.maximum(steps_px.max(axis=1), -steps_px.min(axis=1))
        # A step of many pixels was read off another edge.
        short = np.minimum(1.0, _FAR_PX / np.maximum(moved_px, _FAR_PX))
        poses = poses.moved(steps[:, :6] * short[:, None])
        left_px = off_px - (steps[:, None] @ rows)[:, 0]
        square_px2 = (weights[:, None] @ (left_px * left_px)[..., None])[:, 0, 0] / np.maximum(count, 1e-9)
        if (moved_px < _SETTLED_PX).all():
            break
        far = moved_px > _MOVED_FAR_PX
        # What still lies beside the others, beyond twice their spread, counts for less.
        doubt = np.maximum(1.0, np.abs(left_px) / (_EXACT_PX + 2 * np.sqrt(square_px2))[:, None])
    variances_px2 = square_px2 * count / np.maximum(count - unknowns, 1.0)
    covariances = np.linalg.inv(normal)[:, :6, :6] * variances_px2[:, None, None]
    enough = present.sum(axis=1) > _SEEN * np.abs(prints.polarity).sum(axis=1)
    offsets_px = np.broadcast_to(steps[:, 6] if edge_offset_px is None else edge_offset_px, len(count))
    return _Settled(poses, offsets_px, covariances, enough & (moved_px < _SETTLED_PX))


def _moves(prints: Prints, camera: Array, slopes: Array) -> Array:
    """How far points on edges are seen to move, in px along their axis, per unit of a twist and of the edge
    offset: (m, 7, s)."""
    x, y, level = prints.points[..., 0], prints.points[..., 1], prints.level
    aside = (np.where(level, y - camera[:, 1:2], x - camera[:, :1]) / camera[:, 2:]) * slopes
    rows = np.empty((len(slopes), 7, slopes.shape[1]))
    np.multiply(slopes, level, out=rows[:, 1])
    np.subtract(slopes, rows[:, 1], out=rows[:, 0])
    rows[:, 2] = aside
    np.multiply(aside, y, out=rows[:, 3])
    np.multiply(aside, -x, out=rows[:, 4])
    np.multiply(slopes, prints.swirl, out=rows[:, 5])
    np.negative(prints.polarity, out=rows[:, 6])
    return rows


def _measure(
    grey: Grey, prints: Prints, poses: _Poses, lens: CameraCalibration, far: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """How far edges lie from where they should, along their axis.

    Returns
    -------
    off_px (m, s), their distances; slopes (m, s), px per side of the print; present (m, s), 1.0 or 0.0.
    """
    ends_px = project(poses.into_camera(prints.ends).reshape(-1, 3), lens).reshape(len(far), 2, -1, 2)
    across = (ends_px[:, 1] - ends_px[:, 0]) / 2
    middle = ends_px[:, 0] + across
    lengths_px = np.hypot(across[..., 0], across[..., 1])
    slopes = lengths_px / prints.reach
    cells_px = slopes.min(axis=1) / prints.cells
    reaches_px = np.minimum(np.where(far, _FAR_PX, _NEAR_PX), _OF_CELL * cells_px).round(1)
    taps = (reaches_px[:, None] / lengths_px)[..., None] * _TAPS
    x = (middle[..., :1] + across[..., :1] * taps).astype(np.float32)
    y = (middle[..., 1:] + across[..., 1:] * taps).astype(np.float32)
    profiles = levels_at(grey, x, y)
    templates = np.array([_template(reach_px) for reach_px in reaches_px.tolist()])
    fitted = profiles @ templates
    height = fitted[..., 0]
    contrast = height * prints.polarity
    present = contrast > np.maximum(_WEAK * contrast.mean(axis=1), _LEAST_CONTRAST)[:, None]
    off_px = np.divide(fitted[..., 1], height, out=np.zeros_like(height), where=present)
    if far.any():
        off_px = np.where(far[:, None], _by_area(profiles, reaches_px) * prints.polarity, off_px)
        present = present | far[:, None] & (prints.polarity != 0)
    limit = reaches_px[:, None]
    return np.minimum(np.maximum(off_px, -limit), limit), slopes, present.astype(np.float64)


def _by_area(profiles: Array, reaches_px: Array) -> Array:
    """How far edges lie towards the white, by the share of black in a profile: of use far away."""
    low, high = profiles.min(axis=(1, 2)), profiles.max(axis=(1, 2))
    white = (profiles.mean(axis=2) - low[:, None]) / np.maximum(high - low, 1.0)[:, None]
    by_area: Array = reaches_px[:, None] * (1 - 2 * white)
    return by_area


@cache
def _template(reach_px: float) -> Array:
    """Takes a profile to a blurred step: its height, and height times shift; (taps, 2)."""
    x = reach_px * _TAPS / _BLUR_PX
    bell = np.exp(-(x**2) / 2) / (np.sqrt(2 * np.pi) * _BLUR_PX)
    step = np.column_stack([np.ones_like(x), ndtr(x), -bell])
    return np.asarray(np.linalg.pinv(step)[1:].T.copy(), dtype=np.float64)


def _outline(poses: _Poses, prints: Prints, lens: CameraCalibration) -> tuple[Array, Array, Array]:
    """Corners (m, 4, 2) in px, how they move with a twist (m, 8, 6), and centres of cells (m, c, 2) in px."""
    count = len(poses.centres)
    px = project(poses.into_camera(prints.outline).reshape(-1, 3), lens).reshape(count, -1, 2)
    per_unit = np.stack([px[:, 4:8] - px[:, :4], px[:, 8:12] - px[:, :4]], axis=3) / prints.nudge
    x, y = prints.outline[:4].T
    camera = poses.camera()
    aside_x, aside_y = (x - camera[:, :1]) / camera[:, 2:], (y - camera[:, 1:2]) / camera[:, 2:]
    one, none = np.ones_like(aside_x), np.zeros_like(aside_x)
    inplane = np.stack(
        [
            np.stack([one, none, aside_x, aside_x * y, -aside_x * x, -y * one], axis=2),
            np.stack([none, one, aside_y, aside_y * y, -aside_y * x, x * one], axis=2),
        ],
        axis=2,
    )
    return px[:, :4], (per_unit @ inplane).reshape(count, 8, 6), px[:, 12:]


def _cells(grey: Grey, cells_px: Array) -> Array:
    x, y = cells_px.astype(np.float32).transpose(2, 0, 1)
    return levels_at(grey, np.ascontiguousarray(x), np.ascontiguousarray(y))


def _whole(corners_px: Array, grey: Grey) -> NDArray[np.bool_]:
    last = np.array([grey.shape[1], grey.shape[0]]) - 0.5
    return np.asarray(((corners_px >= -0.5) & (corners_px <= last)).all(axis=(1, 2)))


def _same_cells(levels: Array, white: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether cells are white and black as they should be, (m,), from their grey levels (m, c)."""
    bright = (levels * white).sum(axis=1) / white.sum(axis=1)
    dark = (levels * ~white).sum(axis=1) / (~white).sum(axis=1)
    wrong = ((levels > ((bright + dark) / 2)[:, None]) != white).sum(axis=1)
    same: NDArray[np.bool_] = (wrong <= _WRONG_CELLS) & (bright - dark > _LEAST_CONTRAST)
    return same
