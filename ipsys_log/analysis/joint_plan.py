"""Next points to measure, and the next drive, for a joint calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from ipsys_log.analysis.expected_error import ExpectedErrors, FloorGrid, expect_errors, mean_lengths
from ipsys_log.analysis.plan import MeasurementPlan, PlannedPlace
from ipsys_log.analysis.tape import TapeCovariances
from ipsys_log.analysis.taped_points import choose_points
from ipsys_log.arrays import Array
from ipsys_log.errors import IpsysError
from ipsys_log.joint.model import JointModel


def expect_on_floor(
    models: Mapping[str, JointModel],
    sizes_px: Mapping[str, tuple[int, int]],
    grid: FloorGrid,
    height_m: float,
    length_m: float,
) -> list[ExpectedErrors]:
    """Return the expected errors of all cameras over the floor, see :func:`expect_errors`.

    Raises
    ------
    IpsysError
        No camera sees a whole marker anywhere.
    """
    expected = expect_errors(models, sizes_px, grid, height_m, length_m)
    if not any(len(one.errors_m) for one in expected):
        raise IpsysError(f"no camera sees a whole marker {height_m:g} m above the floor; give another height")
    return expected


def plan_joint_points(
    models: Mapping[str, JointModel],
    sizes_px: Mapping[str, tuple[int, int]],
    expected: Sequence[ExpectedErrors],
    candidates_m: Array,
    tape_m2: TapeCovariances,
    length_m: float,
    count: int,
) -> MeasurementPlan:
    """Choose the points to measure next, and predict the error over the floor after each.

    Parameters
    ----------
    models, sizes_px : by camera.
    expected : from :func:`expect_on_floor`.
    candidates_m : (c, 3), possible positions of a marker.
    tape_m2 : function for the covariances of tape readings.
    length_m : side of the marker.
    count : number of points.

    Raises
    ------
    IpsysError
        No camera sees a candidate.
    """
    flat_m, heights_m = candidates_m[:, :2], candidates_m[:, 2]
    points = choose_points(models, sizes_px, expected, flat_m, tape_m2, length_m, 0.0, count, heights_m)
    if not points:
        raise IpsysError("no camera sees a whole marker at these heights on the floor; give another height")
    updates = [None, *(point.update for point in points)]
    maps_m = _least(expected, updates)
    means_m = [float(np.nanmean(one)) for one in maps_m]
    places = tuple(
        PlannedPlace(np.append(point.point_m, point.height_m), point.cameras, before_m, after_m)
        for point, (before_m, after_m) in zip(points, pairwise(means_m), strict=True)
    )
    return MeasurementPlan(places, maps_m[0], maps_m[-1], {one.camera: one.seen for one in expected})


def _least(expected: Sequence[ExpectedErrors], updates: Sequence[Array | None]) -> list[Array]:
    """Return the least expected error of the cameras at each node, (n,), after each update of the modes.

    The error is NaN if no camera sees the node.
    """
    maps_m = [np.full(len(expected[0].seen), np.nan) for _ in updates]
    for one in expected:
        modes_m = one.modes_m()
        for least_m, update in zip(maps_m, updates, strict=True):
            updated_m = modes_m if update is None else modes_m @ update
            errors_m = mean_lengths(updated_m @ updated_m.swapaxes(1, 2))
            least_m[one.seen] = np.fmin(least_m[one.seen], errors_m)
    return maps_m
