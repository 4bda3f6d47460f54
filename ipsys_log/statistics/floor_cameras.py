"""A grid over the floor, the calibrated cameras above it, of any model, and the effect of a motion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ipsys_log.errors import FitError
from ipsys_log.messages import Array, CameraCalibration, CameraModel, Floor, Mask, Model
from ipsys_log.models.plain_models import rigid_transform
from ipsys_log.statistics.model_kinds import joint_models
from ipsys_log.vision.lenses import check_calibration, in_image, undistort
from ipsys_log.vision.poses import PosedCamera

if TYPE_CHECKING:
    from ipsys_log.calibration.joint.model import JointModel


# Step of the grid, and its least distance from the walls.
GRID_M = 0.1
WALL_M = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """A grid over the floor: coordinates ``xs_m`` (a,) and ``ys_m`` (b,) of its nodes, ``step_m`` apart."""

    xs_m: Array
    ys_m: Array
    step_m: float

    @classmethod
    def over(cls, low_m: Array, high_m: Array, step_m: float = GRID_M) -> FloorGrid:
        """Return the grid over a rectangle, at least 0.3 m from its edges."""
        # The small number keeps a node that is exactly at the limit.
        axes = [
            np.arange(low + WALL_M, high - WALL_M + 1e-6, step_m)
            for low, high in zip(low_m, high_m, strict=True)
        ]
        return cls(axes[0], axes[1], step_m)

    @classmethod
    def of_cells(cls, low_m: Array, high_m: Array, step_m: float) -> FloorGrid:
        """Return the middles of the cells of a rectangle, the first one half a step from its corner."""
        axes = [np.arange(low + step_m / 2, high, step_m) for low, high in zip(low_m, high_m, strict=True)]
        return cls(axes[0], axes[1], step_m)

    @property
    def nodes_m(self) -> Array:
        """The nodes (b * a, 2), row by row."""
        return np.stack(np.meshgrid(self.xs_m, self.ys_m), axis=-1).reshape(-1, 2)

    def patches(self, mask: Mask, least_m2: float) -> list[GridPart]:
        """Return the connected parts of a mask (b, a), not smaller than an area; the largest first."""
        return sorted(self._patches(mask, least_m2), key=lambda patch: -patch.area_m2)

    def _patches(self, mask: Mask, least_m2: float) -> Iterator[GridPart]:
        from scipy.ndimage import find_objects, label  # late: it takes 1 s

        labels, _ = label(mask, np.ones((3, 3)))
        for number, (rows, columns) in enumerate(find_objects(labels), 1):
            area_m2 = float((labels[rows, columns] == number).sum()) * self.step_m**2
            if area_m2 >= least_m2:
                x_m, y_m = self.xs_m[columns], self.ys_m[rows]
                low_m, high_m = np.array([x_m[0], y_m[0]]), np.array([x_m[-1], y_m[-1]])
                yield GridPart(area_m2, low_m, high_m, labels == number)


@dataclass(frozen=True, slots=True, eq=False)
class GridPart:
    """A connected part of a grid: nodes from ``low_m`` to ``high_m`` (2,), and the mask ``inside`` (b, a)."""

    area_m2: float
    low_m: Array
    high_m: Array
    inside: Mask


_STEP_M = 0.25
# Without a floor in the rig, the map reaches this multiple of the camera's height to each side.
_REACH = 1.5
# Points on each side of an image, whose rays outline the field of view.
_OUTLINE = 16
# Tangent of the largest angle of a drawn ray: beyond it, a ray meets the floor far away or never.
_GRAZED = 3.0


def read_floor_cameras(model: Model, lenses: Mapping[str, CameraCalibration]) -> dict[str, PosedCamera]:
    """Return the cameras of a fitted model that have intrinsics and a pose, by name.

    The joint model has the pose and its own intrinsics. For all other models, the pose is the rigid transform
    (eq. 6 to 12 of the paper) from the world points to the camera points of the calibration points.

    Parameters
    ----------
    model : a fitted model.
    lenses : intrinsics by camera; they also give the size of the images.

    Raises
    ------
    IpsysError
        The model of a camera is not complete, or its intrinsics are not valid.
    """
    cameras, joints = {}, joint_models(model)
    for camera in model.cameras:
        if camera.camera not in lenses:
            continue
        lens = check_calibration(lenses[camera.camera], f"calibration of {camera.camera}")
        joint = joints.get(camera.camera)
        own = _rigid_camera(camera, lens) if joint is None else _joint_camera(camera.camera, joint, lens)
        if own is not None and np.isfinite(own.camera_from_world).all() and np.isfinite(own.origin_m).all():
            cameras[own.name] = own
    return cameras


def _joint_camera(name: str, joint: JointModel, lens: CameraCalibration) -> PosedCamera:
    own = joint.calibration
    lens = replace(lens, distortion_model=own.distortion_model, K=own.K, D=own.D)
    return PosedCamera(name, lens, joint.camera_from_world, joint.origin_m)


def _rigid_camera(camera: CameraModel, lens: CameraCalibration) -> PosedCamera | None:
    """Return a camera with the pose that its calibration points give; None if they are too few."""
    world_m = np.array([pair.world_m for pair in camera.pairs]).reshape(-1, 3)
    camera_m = np.array([pair.camera_m for pair in camera.pairs]).reshape(-1, 3)
    if not (np.isfinite(world_m).all() and np.isfinite(camera_m).all()):
        return None
    try:
        turn, shift_m = rigid_transform(world_m, camera_m)
    except FitError:
        return None
    return PosedCamera(camera.camera, lens, turn, -turn.T @ shift_m)


def floor_grid(camera: PosedCamera, floor: Floor | None) -> Array:
    """Return the points (n, 3) of a grid of 0.25 m on the floor that a camera sees.

    Parameters
    ----------
    camera : the camera.
    floor : size of the floor; None: a square below the camera.
    """
    if floor is not None:
        low, high = np.zeros(2), np.array([floor.width_m, floor.depth_m])
    else:
        reach_m = _REACH * abs(float(camera.origin_m[2]))
        low, high = camera.origin_m[:2] - reach_m, camera.origin_m[:2] + reach_m
    grid = FloorGrid.of_cells(low, high, _STEP_M)
    flat_m = np.stack(np.meshgrid(grid.xs_m, grid.ys_m, indexing="ij"), axis=-1).reshape(-1, 2)
    points_m = np.column_stack([flat_m, np.zeros(len(flat_m))])
    return np.asarray(points_m[in_image(camera.transform(points_m), camera.lens)])


def outline_view(camera: PosedCamera) -> Array:
    """Return the outline (k, 2) of the field of view of a camera on the floor, z = 0, in m."""
    along, ends = np.linspace(0.0, 1.0, _OUTLINE, endpoint=False), np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    sides = [
        start + along[:, None] * (end - start) for start, end in zip(ends, np.roll(ends, -1, 0), strict=True)
    ]
    pixels = np.concatenate(sides) * [camera.lens.width - 1, camera.lens.height - 1]
    uv = undistort(pixels, camera.lens)
    uv = uv[np.isfinite(uv).all(axis=1)]
    rays = np.column_stack([uv, np.ones(len(uv))]) @ camera.camera_from_world
    across = np.hypot(rays[:, 0], rays[:, 1])
    # A grazing ray keeps its direction, and ends where a steeper ray meets the floor.
    depths = np.maximum(-rays[:, 2], across / _GRAZED)
    return np.asarray(camera.origin_m[:2] + rays[:, :2] * (camera.origin_m[2] / depths)[:, None])


def shift_floor_map(camera: PosedCamera, points_m: Array, motion: Array) -> Array:
    """Return the errors (n, 2) of positions on the floor, in m, if a camera moves and its model does not.

    The moved camera sees a point on another ray. The model of the camera before the motion meets this ray
    with the floor. The intrinsics have no effect.

    Parameters
    ----------
    camera : the camera before the motion.
    points_m : (n, 3), true points at any height; the positions have the same height.
    motion : (6,), as for :meth:`PosedCamera.move`.

    Examples
    --------
    >>> lens = CameraCalibration(0, "red", 0, 0, "kannala_brandt", np.zeros(4), np.eye(3))
    >>> camera = PosedCamera("red", lens, np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 2.0]))
    >>> shift_floor_map(camera, np.zeros((1, 3)), np.array([0, 0, 0, 0.01, 0, 0])).round(6).tolist()
    [[-0.01, 0.0]]
    """
    rays = camera.move(motion).transform(points_m) @ camera.camera_from_world
    along = (points_m[:, 2] - camera.origin_m[2]) / rays[:, 2]
    return np.asarray(camera.origin_m[:2] + along[:, None] * rays[:, :2] - points_m[:, :2])
