"""The errors of a joint model at nodes of a grid: those of level markers, and of their height."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.locate import LevelPositions, locate_markers
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages import Array
from ipsys_log.models.tracking.bias_modes import FLATTEST
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import level_turns

# The sensitivity of a centre hardly depends on the side of its marker.
_MARKER_M = 0.2
# Standard deviation of a corner of detect: a weight of corners without noise.
_USUAL_PX = 0.012


@dataclass(frozen=True, slots=True, eq=False)
class JointNodes:
    """The sensitivities of one camera at n nodes, computed at each use.

    The errors by all amplitudes, at the nodes of all cameras of a hall, would need 700 MB.

    Attributes
    ----------
    model : the calibrated camera. Its modes are the first M - 1 amplitudes, and the height is the last one.
    corners_px : (n, 4, 2), corners of level markers at the nodes.
    height_m : height of these markers above the floor.
    by_height_m : (n, 3), errors by the amplitude of the height.
    seen : (n,), a mask of the nodes that the camera can see.
    rows : (n,), the nodes by their number in the grid. None: all nodes.
    """

    model: JointModel
    corners_px: Array
    height_m: float
    by_height_m: Array
    seen: NDArray[np.bool_]
    rows: NDArray[np.intp] | None = None

    @property
    def columns(self) -> None:
        """None: the errors depend on all amplitudes."""
        return

    @property
    def rest_m2(self) -> Array:
        """Covariances (n, 3, 3) of local errors: there are none."""
        return np.zeros((len(self.seen), 3, 3))

    @property
    def clock_s(self) -> Array:
        """The error (M,) of the camera's clock by the amplitudes."""
        return np.append(self.model.modes[len(self.model.lens) + 7], 0.0)

    def errors(self) -> Array:
        """Return the errors (n, 3, M) by all amplitudes; NaN at a node that the camera cannot see."""
        return np.concatenate([self._spread(self.model), self.by_height_m[:, :, None]], axis=2)

    def project(self, axes: Array) -> Array:
        """Return the errors (n, 3, k) by combinations (M, k) of the amplitudes."""
        modes, floor_modes = self.model.modes, self.model.floor_modes
        combined = replace(
            self.model, modes=modes @ axes[:-1], floor_modes=floor_modes @ axes[: floor_modes.shape[1]]
        )
        errors: Array = self._spread(combined) + self.by_height_m[:, :, None] * axes[-1]
        return errors

    def _spread(self, model: JointModel) -> Array:
        errors = _locate(model, self.corners_px, self.height_m).modes_m
        errors[~self.seen] = np.nan
        return errors


def make_joint_nodes(
    model: JointModel, flat_m: Array, height_m: float, sigma_m: float, rows: NDArray[np.intp] | None
) -> JointNodes:
    """Return the nodes at the points ``flat_m`` (n, 2) of the floor.

    Parameters
    ----------
    model : the calibrated camera.
    flat_m : (n, 2), the nodes.
    height_m, sigma_m : height of the markers above the floor, and its standard deviation.
    rows : (n,), the nodes by their number in the grid. None: all nodes.
    """
    count = len(flat_m)
    floor_m, _ = model.floor.heights(flat_m, model.amplitudes)
    centres_m = np.column_stack([flat_m, floor_m + height_m])
    arms_m = marker_corners(1.0) * _MARKER_M @ level_turns(np.zeros(count)).swapaxes(1, 2)
    corners_c = (arms_m + (centres_m - model.origin_m)[:, None]) @ model.camera_from_world.T
    steep = (corners_c[..., 2] > FLATTEST * np.linalg.norm(corners_c, axis=2)).all(axis=1)
    corners_px = project(corners_c.reshape(-1, 3), model.calibration).reshape(count, 4, 2)
    corners_px[~steep] = corners_px[steep][:1]
    low, high = (
        _locate(model.without_modes(), corners_px, at_m).points_m for at_m in (height_m, height_m + sigma_m)
    )
    return JointNodes(model, corners_px, height_m, high - low, steep, rows)


def _locate(model: JointModel, corners_px: Array, height_m: float) -> LevelPositions:
    count = len(corners_px)
    variances = np.broadcast_to(_USUAL_PX**2 * np.eye(8), (count, 8, 8))
    return locate_markers(model, corners_px, variances, np.full(count, height_m), np.full(count, _MARKER_M))
