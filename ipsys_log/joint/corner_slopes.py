"""Corners of markers that a calibrated camera sees: their residuals and derivatives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipsys_log.arrays import Array
from ipsys_log.calibration.lens_models import project_with_slopes
from ipsys_log.geometry.markers import marker_corners
from ipsys_log.geometry.rotations import cross
from ipsys_log.joint.model import JointModel

_CORNERS = marker_corners(1.0)


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


def linearise_corners(
    model: JointModel, corners_px: Array, inward: Array, points_m: Array, turns: Array, sizes_m: Array
) -> CornerSlopes:
    """Return residuals and slopes of the corners of markers.

    Parameters
    ----------
    model : the calibrated camera.
    corners_px : (n, 4, 2), measured corners.
    inward : (n, 4, 2), from :func:`edge_motion`.
    points_m, turns : (n, 3) and (n, 3, 3), centres and axes of the markers in the world.
    sizes_m : (n,), sides of the markers.
    """
    count, lens = len(points_m), len(model.lens)
    arms_m = _CORNERS @ turns.swapaxes(1, 2) * sizes_m[:, None, None]
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
