"""Poses of a body as another system states them, in the coordinates and the clock of that system."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array
from ipsys_log.statistics.ground_truth import TrackedPath


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The path of a body in the coordinates and the clock of its file.

    Attributes
    ----------
    name : the name of the body in the file; empty if it has none.
    times_ns : (n,), strictly ascending.
    points_m : (n, 3), positions of the origin of the body.
    quaternions : (n, 4), rotations x y z w from the axes of the body to those of the file; NaN in the rows
        without a rotation. A heading alone is a rotation about z.
    covariances : (n, 6, 6) of x, y, z in m and rotations about x, y, z in rad, as in nav_msgs/Odometry; None
        if the file has none.
    left_out : numbers of rows of the file by what is unusual about them, such as ``without a position``.
    """

    name: str
    times_ns: NDArray[np.int64]
    points_m: Array
    quaternions: Array
    covariances: Array | None = None
    left_out: tuple[tuple[str, int], ...] = ()

    @property
    def axes(self) -> Array:
        """The rotations (n, 3, 3) of the quaternions; NaN in the rows without one."""
        # Late: most commands rotate nothing, and scipy takes long to load.
        from scipy.spatial.transform import Rotation

        found = np.full((len(self.times_ns), 3, 3), np.nan)
        known = np.isfinite(self.quaternions).all(axis=1)
        if known.any():
            found[known] = Rotation.from_quat(self.quaternions[known]).as_matrix()
        return found


class TrajectoryPair(NamedTuple):
    """A robot in both systems."""

    other: Trajectory
    track: TrackedPath


@dataclass(frozen=True, slots=True)
class KnownParts:
    """The parts of an alignment that are given, and not estimated.

    Attributes
    ----------
    offset_ns : to add to the times of the other system.
    align : ``2d`` (rotation about z, translation in x and y), ``3d``, or ``none``.
    pivot_m : from the marker to the origin of the other body, in the axes of the marker.
    with_scale : True for trajectories without a scale, as of monocular SLAM.
    """

    offset_ns: int | None = None
    align: str = "2d"
    pivot_m: tuple[float, float, float] | None = None
    with_scale: bool = False
