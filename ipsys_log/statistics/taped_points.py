"""The points whose tape readings reduce the expected error of a joint calibration most.

The errors of all cameras are linear functions of the same independent normal numbers. So the effect of one
more taped point on the whole floor follows from a small linear system, without a fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages.arrays import Array
from ipsys_log.statistics.expected_error import ExpectedErrors, camera_modes, mean_lengths
from ipsys_log.statistics.tape import TapeCovariances

# Repeatable error of the position of a marker by one camera, for the choice of points.
_CORNER_SIGMA_M = 0.0003
# So many camera-nodes give the mean error over the floor accurately enough for the choice of points.
_ENOUGH_NODES = 800


@dataclass(frozen=True, slots=True, eq=False)
class TapedPoint:
    """A point to measure.

    Attributes
    ----------
    point_m : (2,); ``height_m`` is its height above the floor.
    cameras : those that see it.
    mean_after_m : the expected mean error after it.
    update : (m, m). The modes of the calibration after this point, and all before it, are the present modes
        times this matrix.
    """

    point_m: Array
    height_m: float
    cameras: tuple[str, ...]
    mean_after_m: float
    update: Array


def choose_points(
    models: Mapping[str, JointModel],
    sizes_px: Mapping[str, tuple[int, int]],
    expected: Sequence[ExpectedErrors],
    candidates_m: Array,
    tape_m2: TapeCovariances,
    length_m: float,
    goal_m: float,
    count: int,
    heights_m: Array | float = 0.0,
) -> list[TapedPoint]:
    """Choose the points on the floor whose tape readings reduce the mean expected error most, one by one.

    The choice ends when the error is at most ``goal_m``, after ``count`` points, or without a candidate that
    a camera sees. No point is chosen twice.

    Parameters
    ----------
    models, sizes_px : by camera.
    expected : of all cameras.
    candidates_m : (c, 2), possible points.
    tape_m2 : function for the covariances of their tape readings.
    length_m : side of the marker.
    goal_m : wanted mean error.
    count : the largest number of points.
    heights_m : heights of the candidates above the floor, a number or (c,).

    References
    ----------
    V-optimality, also called I-: Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, ch. 10.
    """
    modes_m = some_modes(expected)
    if not len(modes_m) or not len(candidates_m):
        return []
    heights_m = np.broadcast_to(heights_m, (len(candidates_m),))
    candidates = _Candidates(models, sizes_px, candidates_m, heights_m, tape_m2(candidates_m), length_m)
    chosen: list[TapedPoint] = []
    update = np.eye(modes_m.shape[2])
    mean_m = mean_error(modes_m)
    while len(chosen) < count and mean_m > goal_m:
        best = candidates.choose(modes_m @ update, update)
        if best is None:
            break
        number, step = best
        update = update @ step
        mean_m = mean_error(modes_m @ update)
        cameras = candidates.take(number)
        chosen.append(TapedPoint(candidates_m[number], float(heights_m[number]), cameras, mean_m, update))
    return chosen


def some_modes(expected: Sequence[ExpectedErrors]) -> Array:
    """Return the modes (n, 2, m) of enough camera-nodes for a mean over the floor."""
    counts = [len(one.errors_m) for one in expected]
    every = max(1, sum(counts) // _ENOUGH_NODES)
    firsts = np.cumsum([0, *counts[:-1]])
    # Every n-th node of all cameras: the first one of a camera depends on the number of nodes before it.
    parts = [
        one.modes_m(slice(-first % every, None, every))
        for one, first in zip(expected, firsts.tolist(), strict=True)
    ]
    return np.concatenate(parts)


def mean_error(modes_m: Array) -> float:
    """Return the mean expected error of camera-nodes with modes (n, 2, m)."""
    return float(mean_lengths(modes_m @ modes_m.swapaxes(1, 2)).mean())


def posterior_root(slopes: Array, noise_m2: Array) -> Array:
    """Return a root (m, m) of the covariance of m independent normal numbers after an observation.

    Parameters
    ----------
    slopes, noise_m2 : (k, m) and (k, k), of the observation.
    """
    gain = np.linalg.solve(slopes @ slopes.T + noise_m2, slopes)
    covariance = np.eye(slopes.shape[1]) - slopes.T @ gain
    return np.asarray(np.linalg.cholesky((covariance + covariance.T) / 2))


class _Candidates:
    """Possible points for a taped marker, and the observations that they would give."""

    def __init__(
        self,
        models: Mapping[str, JointModel],
        sizes_px: Mapping[str, tuple[int, int]],
        points_m: Array,
        heights_m: Array,
        tapes_m2: Array,
        length_m: float,
    ) -> None:
        self._seen, self._slopes = {}, {}
        for camera, model in models.items():
            seen, modes_m = camera_modes(model, sizes_px[camera], points_m, heights_m, length_m)
            slopes = np.zeros((len(points_m), *modes_m.shape[1:]))
            slopes[seen] = modes_m
            self._seen[camera], self._slopes[camera] = seen, slopes
        self._tapes_m2 = tapes_m2
        self._free = np.any([*self._seen.values()], axis=0)

    def choose(self, modes_m: Array, update: Array) -> tuple[int, Array] | None:
        """Return the free point that gives the least mean error, and the update of the modes by it.

        ``modes_m`` (n, 2, m) are those after ``update`` (m, m), which has the points that are taken.
        """
        base_m2 = modes_m @ modes_m.swapaxes(1, 2)
        best: tuple[float, int, tuple[Array, Array]] | None = None
        for number in np.flatnonzero(self._free).tolist():
            observed = self._observe(number, update)
            after_m = _mean_after(base_m2, modes_m, *observed)
            if best is None or after_m < best[0]:
                best = after_m, number, observed
        return None if best is None else (best[1], posterior_root(*best[2]))

    def take(self, number: int) -> tuple[str, ...]:
        """Take a point out of the choice; return the cameras that see it."""
        self._free[number] = False
        return tuple(camera for camera, seen in self._seen.items() if seen[number])

    def _observe(self, number: int, update: Array) -> tuple[Array, Array]:
        """Return slopes (k, m) and noise (k, k) of a tape reading: all cameras see the same tape error."""
        own = [self._slopes[camera][number] for camera, seen in self._seen.items() if seen[number]]
        noise_m2 = np.tile(self._tapes_m2[number], (len(own), len(own)))
        noise_m2 += _CORNER_SIGMA_M**2 * np.eye(len(noise_m2))
        return np.concatenate(own) @ update, noise_m2


def _mean_after(base_m2: Array, modes_m: Array, slopes: Array, noise_m2: Array) -> float:
    """Return the mean expected error after an observation; ``base_m2`` (n, 2, 2) is the product of modes."""
    root = np.linalg.cholesky(slopes @ slopes.T + noise_m2)
    gain = np.linalg.solve(root, slopes @ modes_m.reshape(-1, modes_m.shape[2]).T)
    gain = gain.T.reshape(len(modes_m), 2, -1)
    return float(mean_lengths(base_m2 - gain @ gain.swapaxes(1, 2)).mean())
