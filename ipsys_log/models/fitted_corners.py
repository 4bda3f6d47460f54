"""A fitted joint model of a log, ready to be applied to corners: the class of the Python API."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.locate_poses import locate_poses
from ipsys_log.calibration.joint.payload import restore_joint
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Model
from ipsys_log.messages.arrays import Array
from ipsys_log.models.locate_corners import corner_covariances


class LocatedMarkers(NamedTuple):
    """Located markers.

    ``points_m`` (n, 3) are world points, NaN for a marker that the camera cannot see by its model.
    ``headings_rad`` (n,) and ``covariances_m2`` (n, 3, 3) belong to them. ``chi2`` (n,) are squared residuals
    of the corners in units of their noise, with five degrees of freedom at a known height, or two.
    """

    points_m: Array
    headings_rad: Array
    covariances_m2: Array
    chi2: Array


class FittedCornerModel:
    """A fitted model of a log that is applied to the corners of markers.

    Attributes
    ----------
    name : the name in the table of models, such as ``joint``.
    cameras : names of the cameras of the model.
    """

    def __init__(self, model: Model) -> None:
        self.name = model.name
        self.cameras = tuple(camera.camera for camera in model.cameras)
        self._cameras = restore_joint(model)

    def __repr__(self) -> str:
        return f"<FittedCornerModel {self.name} of {', '.join(self.cameras)}>"

    def predict(
        self, camera: str, corners_px: ArrayLike, length_m: ArrayLike, heights_m: ArrayLike | None = None
    ) -> Array:
        """Return world points (n, 3) in m; the parameters are those of :meth:`locate`."""
        return self.locate(camera, corners_px, length_m, heights_m).points_m

    def locate(
        self,
        camera: str,
        corners_px: ArrayLike,
        length_m: ArrayLike,
        heights_m: ArrayLike | None = None,
        covariances_px2: ArrayLike | None = None,
    ) -> LocatedMarkers:
        """Return the positions of markers, with their headings and covariances.

        Parameters
        ----------
        camera : the camera that saw the markers.
        corners_px : corners (n, 4, 2) in px of the raw image, in the order of OpenCV.
        length_m : side of the black squares in m, a number or (n,).
        heights_m : heights of the level markers above the floor in m, a number or (n,). None: the heights are
            unknown, and each marker gets its full pose.
        covariances_px2 : covariances (n, 8, 8) of the corners; None: the usual one of 0.25 px.

        Raises
        ------
        IpsysError
            The model does not know the camera, or an array has another shape.
        """
        corners = np.asarray(corners_px, dtype=np.float64)
        if corners.ndim != 3 or corners.shape[1:] != (4, 2):
            raise IpsysError(f"corners_px has the shape {corners.shape}; give corners (n, 4, 2) in px")
        if camera not in self._cameras:
            raise IpsysError(
                f"the model {self.name} has no camera {camera!r} (it has {', '.join(self.cameras)})"
            )
        count, model = len(corners), self._cameras[camera]
        covariances = (
            corner_covariances([None] * count)
            if covariances_px2 is None
            else _shaped("covariances_px2", covariances_px2, (count, 8, 8))
        )
        lengths = _shaped("length_m", length_m, (count,))
        if heights_m is None:
            poses = locate_poses(model, corners, covariances, lengths)
            return LocatedMarkers(poses.points_m, poses.headings_rad, poses.covariances_m2, poses.chi2)
        heights = _shaped("heights_m", heights_m, (count,))
        found = locate_markers(model, corners, covariances, heights, lengths)
        return LocatedMarkers(found.points_m, found.headings_rad, found.covariances_m2, found.chi2)


def _shaped(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return an array of a shape; a single value or covariance is that of all markers."""
    array = np.asarray(values, dtype=np.float64)
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise IpsysError(f"{name} has the shape {array.shape}; give {shape}") from None
