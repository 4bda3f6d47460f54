"""Modes of the calibration errors from a fitted model of a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraModel, Model, Rig
from ipsys_log.models.table import AppliedModel, reads_corners
from ipsys_log.models.tracking.bias_modes import (
    FLATTEST,
    BiasModes,
    CameraNodes,
    Grid,
    NodeModes,
    reduce_modes,
)

if TYPE_CHECKING:
    from ipsys_log.calibration.joint.model import JointModel
    from ipsys_log.models.tracking.joint_nodes import JointNodes

# The number of modes, the distance of the nodes, and their reach beyond the calibration points.
MODES = 12
_SPACING_M, _MARGIN_M = 0.2, 0.5
_ROBOT_HEIGHT_M = 0.1
# With more nodes of all cameras together, each camera has only the nodes in its view, with this factor.
_MOST_NODES, _VIEW_MARGIN = 100_000, 1.2


def calibration_modes(model: Model, rig: Rig | None, count: int = MODES) -> BiasModes:
    """Return the errors of a calibration as modes over the floor.

    Parameters
    ----------
    model : a fitted model of all cameras.
    rig : the heights of the markers on robots.
    count : the number of modes.

    Returns
    -------
    BiasModes : without modes if the model has no covariance.
    """
    joints: Mapping[str, JointModel] = {}
    if reads_corners(model.name):
        from ipsys_log.calibration.joint.payload import restore_joint

        joints = restore_joint(model)
    grid = _grid(model, joints)
    if grid is None:
        return BiasModes.none()
    heights_m = [rig.height_of(marker.id) for marker in rig.markers] if rig else []
    known_m = [height_m for height_m in heights_m if height_m is not None]
    usual_m = rig.marker_height_m if rig and rig.marker_height_m is not None else _ROBOT_HEIGHT_M
    height_m = float(np.median(known_m)) if known_m else usual_m
    sigma_m = _height_sigma(rig)
    # In a small lab, each camera sees most nodes.
    in_view = len(grid.points_m) * len(model.cameras) > _MOST_NODES
    nodes: Mapping[str, CameraNodes]
    if joints:
        nodes = {
            name: _joint_nodes(joint, grid, height_m, sigma_m, in_view) for name, joint in joints.items()
        }
    else:
        separate = {
            camera.camera: _table_nodes(model.name, camera, grid, height_m, sigma_m, in_view)
            for camera in model.cameras
        }
        nodes = _side_by_side({name: node for name, node in separate.items() if node is not None})
    return reduce_modes(grid, nodes, count)


def _height_sigma(rig: Rig | None) -> float | None:
    """Return the usual standard deviation of the heights of the rig; None if the rig has none."""
    sigmas_m = [rig.height_sigma_of(marker.id) for marker in rig.markers] if rig else []
    known_m = [sigma_m for sigma_m in sigmas_m if sigma_m is not None]
    return float(np.median(known_m)) if known_m else None


def _grid(model: Model, joints: Mapping[str, JointModel]) -> Grid | None:
    """Return a grid over the calibration points, or around the cameras of a joint model without points."""
    points_m = [pair.world_m[:2] for camera in model.cameras for pair in camera.pairs]
    if joints:
        points_m += _below_cameras([joint.origin_m for joint in joints.values()])
    if not points_m:
        return None
    low_m = np.min(points_m, axis=0) - _MARGIN_M
    sizes = np.ceil((np.max(points_m, axis=0) + _MARGIN_M - low_m) / _SPACING_M).astype(int) + 1
    return Grid(low_m, _SPACING_M, (int(sizes[0]), int(sizes[1])))


def _below_cameras(origins_m: Sequence[Array]) -> list[Array]:
    """Return points of the floor around each camera of a joint model, which it sees."""
    reaches_m = [reach * origin_m[2] for origin_m in origins_m for reach in (-1.0, 1.0)]
    return [
        origin_m[:2] + reach_m
        for origin_m, reach_m in zip(np.repeat(origins_m, 2, axis=0), reaches_m, strict=True)
    ]


def _joint_nodes(
    model: JointModel, grid: Grid, height_m: float, sigma_m: float | None, in_view: bool
) -> JointNodes:
    """Return the modes of a joint model: those of level markers at the nodes, and the error of the height.

    ``sigma_m`` is the standard deviation of the height; None for the usual one. ``in_view``: only
    of the nodes in the view of the camera.
    """
    # Late: scipy takes 1 s.
    from ipsys_log.calibration.joint.settings import JointSettings
    from ipsys_log.models.tracking.joint_nodes import make_joint_nodes

    sigma_m = JointSettings().robot_height_sigma_m if sigma_m is None else sigma_m
    flat_m, rows = grid.points_m, None
    if in_view:
        rays = (np.insert(flat_m, 2, height_m, axis=1) - model.origin_m) @ model.camera_from_world.T
        # The principal point is near the middle of the image, whose size the model does not have.
        rows = _rows_in_view(rays, model.lens[2:4] / model.lens[:2])
        flat_m = flat_m[rows]
    return make_joint_nodes(model, flat_m, height_m, sigma_m, rows)


def _rows_in_view(points_c: Array, most: Array) -> NDArray[np.intp]:
    """Return the rows of points (n, 3) in camera coordinates with x/z and y/z up to ``most`` (2,), or nearly.

    The nearest point is always one of them.
    """
    ahead = points_c[:, 2] > 0
    shares = np.abs(points_c[:, :2]) / np.where(ahead, points_c[:, 2], 1.0)[:, None] / (_VIEW_MARGIN * most)
    largest = np.where(ahead, shares.max(axis=1), np.inf)
    return np.flatnonzero(largest <= max(1.0, largest.min()))


def _table_nodes(
    name: str, camera: CameraModel, grid: Grid, height_m: float, sigma_m: float | None, in_view: bool
) -> NodeModes | None:
    """Return the modes of a model of the table, at the camera points of the nodes; None if it has none."""
    from ipsys_log.models.plain_models import rigid_transform

    applied = AppliedModel(name, camera)
    fitted_m = np.array([pair.camera_m for pair in camera.pairs])
    world_m = np.array([pair.world_m for pair in camera.pairs])
    # The rigid transform is a few cm wrong: the sensitivities hardly change over that distance.
    rotation, origin_m = rigid_transform(world_m, fitted_m)
    flat_m, rows = grid.points_m, None
    points_m = np.column_stack([flat_m, np.full(len(flat_m), height_m)]) @ rotation.T + origin_m
    if in_view:
        rows = _rows_in_view(points_m, np.abs(fitted_m[:, :2] / fitted_m[:, 2:]).max(axis=0))
        flat_m, points_m = flat_m[rows], points_m[rows]
    steep = points_m[:, 2] > FLATTEST * np.linalg.norm(points_m, axis=1)
    points_m[~steep] = fitted_m[0]
    sigmas_m = None if sigma_m is None else np.full(len(flat_m), sigma_m)
    parts = applied.error_modes(points_m, np.full(len(flat_m), height_m), sigmas_m)
    if parts is None:
        return None
    modes_m, rest_m2 = parts
    modes_m[~steep] = np.nan
    rest_m2[~steep] = np.nan
    return NodeModes(modes_m, rest_m2, np.zeros(modes_m.shape[2]), rows)


def _side_by_side(cameras: dict[str, NodeModes]) -> dict[str, NodeModes]:
    """Return the nodes with the amplitudes of all cameras: each has its own, and the last one is common."""
    counts = [node.modes_m.shape[2] - 1 for node in cameras.values()]
    ends = np.cumsum([0, *counts])
    joined = {}
    for number, (name, node) in enumerate(cameras.items()):
        if node.rows is not None:
            # The zeros of all other cameras of a hall need too much memory.
            columns = np.append(np.arange(ends[number], ends[number + 1]), ends[-1])
            joined[name] = NodeModes(node.modes_m, node.rest_m2, np.zeros(ends[-1] + 1), node.rows, columns)
            continue
        modes_m = np.zeros((*node.modes_m.shape[:2], ends[-1] + 1))
        modes_m[:, :, ends[number] : ends[number + 1]] = node.modes_m[:, :, :-1]
        modes_m[:, :, -1] = node.modes_m[:, :, -1]
        joined[name] = NodeModes(modes_m, node.rest_m2, np.zeros(ends[-1] + 1), node.rows)
    return joined
