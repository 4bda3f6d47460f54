"""Rough poses of cameras before the joint fit, when hardly any point was measured with the tape."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.calibration.joint.start import place_cameras
from ipsys_log.errors import FitError
from tests.joint.small_lab import Truth, make_lab


@pytest.fixture(scope="module")
def lab() -> tuple[Observations, Truth]:
    return make_lab(4, points=24, noise_px=0.0, tape_sigma_m=0.0, ruler_sigma_m=0.0, lens_error=False)


def measured_only(observations: Observations, numbers: Collection[int]) -> Observations:
    """Return the observations with tape measurements of some points; others keep their sightings."""
    points = tuple(
        point if number in numbers else replace(point, start_m=None)
        for number, point in enumerate(observations.points)
    )
    return replace(observations, points=points)


def seen_by(observations: Observations) -> list[set[int]]:
    return [set(sightings.point.tolist()) for sightings in observations.sightings]


def origin_errors_m(observations: Observations, truth: Truth) -> list[float]:
    origins = [-pose[:3, :3].T @ pose[:3, 3] for pose in truth.camera_from_world]
    placed = place_cameras(observations)
    return [float(np.linalg.norm(one.origin_m - true)) for one, true in zip(placed, origins, strict=True)]


def far_pair(truth: Truth, first: Collection[int], second: Collection[int]) -> tuple[int, int]:
    """Return the points of two groups that are farthest from each other."""
    pairs = [(one, two) for one in sorted(first) for two in sorted(second)]
    return max(pairs, key=lambda p: float(np.linalg.norm(np.subtract(*truth.places_m[list(p), :2]))))


def test_cameras_with_all_points_are_placed(lab: tuple[Observations, Truth]) -> None:
    assert max(origin_errors_m(*lab)) < 0.1


def test_camera_without_measured_points_is_placed_by_shared_markers(lab: tuple[Observations, Truth]) -> None:
    observations, truth = lab
    first, second = seen_by(observations)
    own = first - second
    assert max(origin_errors_m(measured_only(observations, own), truth)) < 0.15


def test_group_is_placed_by_one_measured_point_of_each_camera(lab: tuple[Observations, Truth]) -> None:
    """No camera sees two measured points; both cameras share markers of unmeasured points."""
    observations, truth = lab
    first, second = seen_by(observations)
    assert first & second
    few = measured_only(observations, far_pair(truth, first - second, second - first))
    assert max(origin_errors_m(few, truth)) < 0.15


def test_one_measured_point_is_refused(lab: tuple[Observations, Truth]) -> None:
    observations, _ = lab
    with pytest.raises(FitError, match="measure at least two points with the tape, some metres apart"):
        place_cameras(measured_only(observations, {0}))
