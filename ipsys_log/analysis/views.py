"""What a fitted camera sees of the world: the way back from a place to its image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ipsys_log.geometry.lenses import in_picture
from ipsys_log.geometry.poses import transform
from ipsys_log.messages import CameraCalibration
from ipsys_log.models.rays import directions
from ipsys_log.models.uncertainty import Predict, Uncertainty

__all__ = ["View"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The corners of a marker of any heading lie on a circle; so many points of it are looked at.
_RIM = 12
# Where the lens is not known, so far beyond the outermost places (in u and v) a camera sees.
_BEYOND = 0.05
# Directions (u, v) nearer together than this are one.
_SAME_RAY = 1e-3
_GRAZED = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A fitted camera: what it sees of the world, and how far off its positions are.

    Attributes
    ----------
    camera_from_world, bend : (4, 4) and (3,), fitted: the pose, and the correction of the lens as
        :func:`ipsys_log.models.rays.directions` takes it.
    lens : its calibration, None where it is not known.
    fitted_m : (n, 3), world points of the places that it was fitted on, as ``uncertainty`` has them.
    """

    camera: str
    camera_from_world: Array
    bend: Array
    lens: CameraCalibration | None
    predict: Predict
    uncertainty: Uncertainty
    fitted_m: Array

    def points(self, world_m: Array) -> Array:
        """Camera points (n, 3) of world points (n, 3); NaN where there is none."""
        inside_m = transform(self.camera_from_world, world_m)
        # Nothing is seen, and no model holds, where the view is grazed.
        ahead = np.hypot(inside_m[:, 0], inside_m[:, 1]) < _GRAZED * inside_m[:, 2]
        depths_m = np.where(ahead, inside_m[:, 2], np.nan)[:, None]
        said = true = inside_m / depths_m
        for _ in range(5):  # to what the model bends to the true direction
            said = said + true - directions(said, self.bend)
        lost = ~(np.abs(directions(said, self.bend) - true).max(axis=1) < _SAME_RAY)
        return np.where(lost[:, None], np.nan, said * depths_m)

    def sees(self, world_m: Array, radius_m: float) -> Mask:
        """Whether level discs about world points (n, 3) lie in the image whole, (n,).

        Without a lens: whether the points lie, in the image, among the fitted places or a little beyond.
        """
        if self.lens is None:
            fitted, at = (p[:, :2] / p[:, 2:] for p in (self.uncertainty.points_m, self.points(world_m)))
            edges = ConvexHull(fitted).equations
            return np.asarray((at @ edges[:, :2].T + edges[:, 2]).max(axis=1) <= _BEYOND, dtype=np.bool_)
        angles = np.linspace(0, 2 * np.pi, _RIM, endpoint=False)
        rim_m = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(_RIM)], axis=1)
        whole = in_picture(self.points(world_m), self.lens)
        rims_m = (world_m[whole, None] + rim_m).reshape(-1, 3)
        whole[whole] = in_picture(self.points(rims_m), self.lens).reshape(-1, _RIM).all(axis=1)
        return whole
