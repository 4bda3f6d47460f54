"""Tape readings that contradict the shape of the points: the most probable explanation, or a doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.observations import CalibrationPoint
from ipsys_log.calibration.joint.tape_explanations import (
    Change,
    PointShape,
    explain_readings,
    side_contradicts,
)
from tests.joint.small_lab import REFERENCES_M, Array

PLACES_M = np.array([[0.9, 0.8], [3.1, 4.1], [4.2, 1.1], [2.0, 3.3], [2.9, 0.7], [0.6, 3.9]])
# All references are on this line.
LINE_Y_M = REFERENCES_M[0, 1]


def taped(places_m: Array, seed: int = 3) -> list[CalibrationPoint]:
    rng = np.random.default_rng(seed)
    points = []
    for number, place_m in enumerate(places_m):
        ranges_m = np.linalg.norm(place_m - REFERENCES_M, axis=1) + rng.normal(0, 0.003, 2)
        points.append(
            CalibrationPoint(f"p{number}", 0, REFERENCES_M, ranges_m, np.full(2, 0.003), start_m=place_m)
        )
    return points


def shape_of(places_m: Array, seed: int = 4) -> PointShape:
    """Return the places in turned coordinates, with errors of 1 mm and of the scale."""
    rng = np.random.default_rng(seed)
    cos, sin = np.cos(2.0), np.sin(2.0)
    turned = places_m @ np.array([[cos, sin], [-sin, cos]]) + [3.0, -1.0]
    scale = turned - turned.mean(axis=0)
    covariance = 0.001**2 * np.eye(2 * len(turned)) + 0.003**2 * np.outer(scale.ravel(), scale.ravel())
    errors = np.linalg.cholesky(covariance) @ rng.standard_normal(2 * len(turned))
    return PointShape(turned + errors.reshape(-1, 2), covariance)


def flip(point: CalibrationPoint) -> CalibrationPoint:
    assert point.start_m is not None
    return replace(point, start_m=np.array([point.start_m[0], 2 * LINE_Y_M - point.start_m[1]]))


def exchange(point: CalibrationPoint) -> CalibrationPoint:
    assert point.start_m is not None
    mirrored = np.array([REFERENCES_M[:, 0].sum() - point.start_m[0], point.start_m[1]])
    return replace(point, distances_m=point.distances_m[::-1], start_m=mirrored)


@pytest.mark.parametrize("seed", range(4))
def test_right_readings_have_one_explanation_without_change(seed: int) -> None:
    (explanation,) = explain_readings(taped(PLACES_M, seed), shape_of(PLACES_M, seed + 50))
    assert explanation.changes == ()
    assert np.abs(explanation.places_m - PLACES_M).max() < 0.02


@pytest.mark.parametrize("number", range(4))
def test_wrong_side_of_one_of_four_points_is_named(number: int) -> None:
    points = taped(PLACES_M[:4])
    points[number] = flip(points[number])
    (explanation,) = explain_readings(points, shape_of(PLACES_M[:4]))
    assert explanation.changes == (Change(f"p{number}", "side"),)
    assert np.abs(explanation.places_m - PLACES_M[:4]).max() < 0.02


def test_exchanged_distances_are_named() -> None:
    points = taped(PLACES_M)
    points[2] = exchange(points[2])
    (explanation,) = explain_readings(points, shape_of(PLACES_M))
    assert explanation.changes == (Change("p2", "exchanged"),)


def test_two_wrong_sides_are_named() -> None:
    points = taped(PLACES_M)
    points[1], points[4] = flip(points[1]), flip(points[4])
    (explanation,) = explain_readings(points, shape_of(PLACES_M))
    assert explanation.changes == (Change("p1", "side"), Change("p4", "side"))


def test_readings_of_two_exchanged_points_are_named() -> None:
    points = taped(PLACES_M)
    one, two = points[0], points[3]
    points[0] = replace(one, distances_m=two.distances_m, start_m=two.start_m)
    points[3] = replace(two, distances_m=one.distances_m, start_m=one.start_m)
    (explanation,) = explain_readings(points, shape_of(PLACES_M))
    assert explanation.changes == (Change("p0", "swapped", "p3"), Change("p3", "swapped", "p0"))


def test_wrong_distance_is_no_wrong_side() -> None:
    points = taped(PLACES_M)
    points[5] = replace(points[5], distances_m=points[5].distances_m + np.array([0.1, 0.0]))
    (explanation,) = explain_readings(points, shape_of(PLACES_M))
    assert explanation.changes == (Change("p5", "distance"),)


def test_one_wrong_side_of_two_points_has_two_explanations() -> None:
    """The lab turned by half a turn fits as well, with the other point on its other side."""
    points = taped(PLACES_M[:2])
    points[0] = flip(points[0])
    explanations = explain_readings(points, shape_of(PLACES_M[:2]))
    assert {one.changes for one in explanations} == {(Change("p0", "side"),), (Change("p1", "side"),)}


def test_side_near_the_line_contradicts_by_its_sigma() -> None:
    point = flip(taped(np.array([[2.0, LINE_Y_M - 0.02]]))[0])
    place_m = np.array([2.0, LINE_Y_M - 0.02])
    assert side_contradicts(point, place_m, 0.003**2 * np.eye(2))
    assert not side_contradicts(point, place_m, 0.01**2 * np.eye(2))
    assert not side_contradicts(flip(point), place_m, 0.003**2 * np.eye(2))
