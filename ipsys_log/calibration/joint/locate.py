"""Positions of markers from their corners, by a joint model and the heights of the markers.

The residuals and derivatives of the corners also serve other estimates.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.lens_models import project_with_slopes
from ipsys_log.messages import Array, Marker
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import cross, level_turns

# Corners without a covariance have about this error.
_CORNER_SIGMA_PX = 0.25
_FLAT = np.array([0, 1, 5])
_CORNERS = marker_corners(1.0)


def corner_covariances(covariances_px2: Sequence[Array | None]) -> Array:
    """Return the covariances (n, 8, 8) of corners, with the usual one for those that have none."""
    unknown = _CORNER_SIGMA_PX**2 * np.eye(8)
    return np.array([unknown if one is None else one for one in covariances_px2]).reshape(-1, 8, 8)


@dataclass(frozen=True, slots=True, eq=False)
class LevelPositions:
    """Positions of n level markers in the world.

    Attributes
    ----------
    points_m : (n, 3), NaN for a marker that the camera cannot see by its model.
    headings_rad : (n,), as ``Position.heading_rad``.
    covariances_m2 : (n, 3, 3), of the points: noise, calibration, floor, height, and tilt.
    chi2 : (n,), squared residuals in units of the noise, with five degrees of freedom.
    modes_m : (n, 3, m), errors of the points by the modes of the calibration. The covariance of two points
        by their calibration is the product of their modes.
    noise_m2 : (n, 3, 3), the part of the covariances by the noise of the corners and the tilt.
    heading_noise_rad : (n,), standard deviation of the headings by the same noise.
    """

    points_m: Array
    headings_rad: Array
    covariances_m2: Array
    chi2: Array
    modes_m: Array
    noise_m2: Array
    heading_noise_rad: Array


def locate_markers(
    model: JointModel,
    corners_px: Array,
    covariances_px2: Array,
    heights_m: Array,
    lengths_m: Array,
    height_sigmas_m: Array | float = 0.001,
    tilt_sigma_rad: float = 0.005,
) -> LevelPositions:
    """Return the positions of level markers at known heights above the floor.

    The rays of the corners meet the height of the marker: this is the exact position if the corners have no
    noise. One step of weighted least squares follows, because corners have different noise.

    Parameters
    ----------
    model : the calibrated camera.
    corners_px : (n, 4, 2), in px of the raw image, in OpenCV's order.
    covariances_px2 : (n, 8, 8), of x0 y0 .. x3 y3.
    heights_m : (n,), heights of the markers above the floor.
    lengths_m : (n,), nominal sides of the markers.
    height_sigmas_m : standard deviation of the heights: a number, or (n,).
    tilt_sigma_rad : standard deviation of the tilt about either axis.
    """
    inward = edge_motion(corners_px)
    points_m, headings_rad, floor_slopes, floor_modes = start_level(model, corners_px, inward, heights_m)
    arms_m = marker_arms(level_turns(headings_rad), lengths_m * model.scale)
    now = linearise_corners(model, corners_px, inward, points_m, arms_m)
    by_height = now.by_pose[:, :, 2:3]
    slopes = now.by_pose[:, :, _FLAT]
    slopes[:, :, :2] += by_height * floor_slopes[:, None]
    tilts = now.by_pose[:, :, 3:5] * tilt_sigma_rad
    variances = covariances_px2 + tilts @ tilts.swapaxes(1, 2) + model.corner_floor_px**2 * np.eye(8)
    weights = np.linalg.inv(variances)
    across = slopes.swapaxes(1, 2) @ weights
    spread = np.linalg.inv(across @ slopes)
    # The change of x, y and heading by a change of the corners, (n, 3, 8).
    gains = spread @ across
    change = (gains @ now.residuals[:, :, None])[:, :, 0]
    left = now.residuals[:, :, None] - slopes @ change[:, :, None]
    # A motion in x and y also changes z, by the slope of the floor.
    lift = np.zeros((len(points_m), 3, 2))
    lift[:, 0, 0] = lift[:, 1, 1] = 1.0
    lift[:, 2] = floor_slopes
    points_m = points_m - (lift @ change[:, :2, None])[:, :, 0]
    gains = lift @ gains[:, :2]
    by_height = -(gains @ by_height)
    by_height[:, 2] += 1.0
    modes_m = model.error_modes(-(gains @ now.by_camera), by_height, floor_modes)
    noise_m2 = lift @ spread[:, :2, :2] @ lift.swapaxes(1, 2)
    covariances = noise_m2 + modes_m @ modes_m.swapaxes(1, 2)
    by_height = by_height * np.reshape(height_sigmas_m, (-1, 1, 1))
    covariances += by_height @ by_height.swapaxes(1, 2)
    headings_rad = (headings_rad - change[:, 2] + np.pi) % (2 * np.pi) - np.pi
    chi2 = (left.swapaxes(1, 2) @ weights @ left)[:, 0, 0]
    return LevelPositions(
        points_m, headings_rad, covariances, chi2, modes_m, noise_m2, np.sqrt(spread[:, 2, 2])
    )


def exposure_offset_ns(model: JointModel, marker: Marker) -> int:
    """Return the time from the stamp of the frame to the exposure of a marker, by the common clock, in ns."""
    rows = float(marker.corners_px[:, 1].mean())
    return (marker.time_offset_ns or 0) + round((rows * model.row_time_s + model.clock_s) * NS_PER_S)


class CornerSlopes(NamedTuple):
    """Residuals (n, 8) of corners in px, and their slopes (n, 8, ...).

    ``by_pose`` (n, 8, 6) are those by a motion and a turn in world axes. ``by_camera`` (n, 8, q + 10) are
    those by the unknowns of the camera, in the order of the rows of :attr:`JointModel.modes`.
    """

    residuals: Array
    by_pose: Array
    by_camera: Array


def edge_motion(corners_px: Array) -> Array:
    """Return the motion of corners, (n, 4, 2), if each edge moves into the marker by 1 px.

    Parameters
    ----------
    corners_px : (n, 4, 2), in order around the marker.

    Examples
    --------
    >>> corners_px = np.array([[[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]])
    >>> edge_motion(corners_px)[0].tolist()
    [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
    """
    after = corners_px[:, [1, 2, 3, 0]] - corners_px
    units = after / np.sqrt((after * after).sum(axis=2, keepdims=True))
    return np.asarray(units - units[:, [3, 0, 1, 2]])


def marker_arms(turns: Array, sizes_m: Array) -> Array:
    """Return the vectors (n, 4, 3) from the centres of markers to their corners, in the world.

    ``turns`` (n, 3, 3) are their axes, ``sizes_m`` (n,) their sides.
    """
    arms_m: Array = _CORNERS @ turns.swapaxes(1, 2) * sizes_m[:, None, None]
    return arms_m


def linearise_corners(
    model: JointModel, corners_px: Array, inward: Array, points_m: Array, arms_m: Array
) -> CornerSlopes:
    """Return residuals and slopes of the corners of markers.

    Parameters
    ----------
    model : the calibrated camera.
    corners_px : (n, 4, 2), measured corners.
    inward : (n, 4, 2), from :func:`edge_motion`.
    points_m, arms_m : (n, 3) and (n, 4, 3): the centres of the markers, or the origins of their bodies, and
        the vectors from there to the corners, in the world. A turn is one about these points.
    """
    count, lens = len(points_m), len(model.lens)
    points_c = (arms_m + (points_m - model.origin_m)[:, None]) @ model.camera_from_world.T
    pixels, by_point, by_lens = project_with_slopes(model.lens_model, model.lens, points_c.reshape(-1, 3))
    by_point = by_point.reshape(count, 4, 2, 3)
    by_pose = np.empty((count, 4, 2, 6))
    by_pose[..., :3] = by_world = by_point @ model.camera_from_world
    by_pose[..., 3:] = cross(arms_m[:, :, None], by_world)
    # Without a speed, the clock and the row time have no effect.
    by_camera = np.zeros((count, 4, 2, lens + 10))
    by_camera[..., :3] = cross(points_c[:, :, None], by_point)
    by_camera[..., 3:6] = -by_world
    by_camera[..., 6 : 6 + lens] = by_lens.reshape(count, 4, 2, lens)
    by_camera[..., 6 + lens] = inward
    by_camera[..., 9 + lens] = (by_world * arms_m[:, :, None]).sum(axis=3) / model.scale
    misses = pixels.reshape(count, 4, 2) + model.edge_offset_px * inward - corners_px
    return CornerSlopes(
        misses.reshape(count, 8), by_pose.reshape(count, 8, 6), by_camera.reshape(count, 8, -1)
    )


def start_level(
    model: JointModel, corners_px: Array, inward: Array, heights_m: Array
) -> tuple[Array, Array, Array, Array]:
    """Return points (n, 3) and headings (n,) from the rays of the corners; slopes and modes of the floor."""
    uv = undistort((corners_px - model.edge_offset_px * inward).reshape(-1, 2), model.calibration)
    rays = (np.column_stack([uv, np.ones(len(uv))]) @ model.camera_from_world).reshape(-1, 4, 3)
    origin_m = model.origin_m
    rays = rays / np.where(rays[..., 2:] < 0, rays[..., 2:], np.nan)
    away = rays.mean(axis=1)
    middle_m = origin_m + (heights_m - origin_m[2])[:, None] * away
    floor_m, slopes, modes = model.floor.evaluate(np.nan_to_num(middle_m), model.amplitudes)
    points_m = middle_m + floor_m[:, None] * away
    side = rays[:, 2] + rays[:, 3] - rays[:, 0] - rays[:, 1]
    return points_m, np.arctan2(side[:, 1], side[:, 0]), slopes, modes
