"""Faults in the observations of a joint fit are named, and others are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.diagnosis import find_faults, standardise_readings
from ipsys_log.calibration.joint.fit import Finding, fit_jointly
from ipsys_log.calibration.joint.hypotheses import fit_hypotheses
from ipsys_log.calibration.joint.moved_cameras import find_motion, sum_squares
from ipsys_log.calibration.joint.observations import CalibrationPoint, Observations, marker_body
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import make_pose, pose_facing_up, rotation, transform
from tests.joint.small_lab import LENGTH_M, Array, Truth, make_lab


@pytest.fixture(scope="module")
def lab() -> tuple[Observations, Truth]:
    return make_lab(5, points=24, cameras=3)


def exchange(observations: Observations, points: dict[int, CalibrationPoint]) -> Observations:
    """Return the observations with other calibration points, by their numbers."""
    return replace(
        observations,
        points=tuple(points.get(number, point) for number, point in enumerate(observations.points)),
    )


def first_fault(observations: Observations) -> Finding:
    return find_faults(fit_hypotheses(observations))[0]


def turn_camera(observations: Observations, truth: Truth, camera: int, turn_rad: float) -> Observations:
    """Return observations in which a camera turns after half of its sightings."""
    sightings = observations.sightings[camera]
    lens, pose = truth.lenses[camera], truth.camera_from_world[camera]
    turned = make_pose(rotation(np.array([turn_rad, 0.0, 0.0])), np.zeros(3)) @ pose
    pixels = sightings.pixels.copy()
    for row in range(len(sightings) // 2, len(sightings)):
        x, y, z, heading = truth.places_m[sightings.point[row]]
        corners_m = transform(pose_facing_up(x, y, z, heading), marker_corners(LENGTH_M))
        before, after = (project(transform(one, corners_m), lens) for one in (pose, turned))
        pixels[row] += after - before
    moved = replace(sightings, pixels=pixels)
    return replace(
        observations,
        sightings=tuple(moved if n == camera else one for n, one in enumerate(observations.sightings)),
    )


def test_good_observations_have_no_fault(lab: tuple[Observations, Truth]) -> None:
    fit = fit_jointly(lab[0])
    assert find_faults(fit) == []
    scores = [reading.score for reading in standardise_readings(fit)]
    assert 0.85 < np.sqrt(np.mean(np.square(scores))) < 1.15


def test_wrong_tape_reading_is_named(lab: tuple[Observations, Truth]) -> None:
    point = lab[0].points[3]
    longer = replace(point, distances_m=point.distances_m + np.array([0.1, 0.0]))
    fault = first_fault(exchange(lab[0], {3: longer}))
    assert (fault.kind, fault.subject) == ("distance", "p3")
    assert "distance 1 is" in fault.text
    assert "too long" in fault.text


def test_wrong_height_is_named(lab: tuple[Observations, Truth]) -> None:
    point = lab[0].points[3]
    assert point.height_m is not None
    fault = first_fault(exchange(lab[0], {3: replace(point, height_m=point.height_m + 0.05)}))
    assert (fault.kind, fault.subject) == ("height", "p3")


def test_swapped_points_are_named(lab: tuple[Observations, Truth]) -> None:
    one, two = lab[0].points[3], lab[0].points[7]
    tapes = [{"distances_m": point.distances_m, "start_m": point.start_m} for point in (one, two)]
    swapped = {3: replace(one, **tapes[1]), 7: replace(two, **tapes[0])}  # type: ignore[arg-type]
    faults = find_faults(fit_jointly(exchange(lab[0], swapped)))
    assert {(fault.kind, fault.subject) for fault in faults} == {("swapped", "p3"), ("swapped", "p7")}


def test_wrong_side_of_markers_is_estimated(lab: tuple[Observations, Truth]) -> None:
    observations = replace(lab[0], bodies=(marker_body("0", 0.18, 0.003),))
    fault = first_fault(observations)
    assert (fault.kind, fault.subject) == ("length", "0")
    # The scale of the tape, and so that of the side, is known to 0.1 %.
    assert abs(float(fault.text.split("its side is ")[1].split()[0]) - 20.0) < 0.05
    assert "cm, not 18.00 cm" in fault.text


def test_moved_camera_alone_is_accused(lab: tuple[Observations, Truth]) -> None:
    faults = find_faults(fit_hypotheses(turn_camera(*lab, camera=1, turn_rad=np.radians(0.3))))
    assert [(fault.kind, fault.subject) for fault in faults] == [("camera", "c1")]


def test_moved_camera_is_named(lab: tuple[Observations, Truth]) -> None:
    fault = first_fault(turn_camera(*lab, camera=1, turn_rad=np.radians(0.2)))
    assert (fault.kind, fault.subject) == ("camera", "c1")
    assert "0.19 degrees" in fault.text or "0.2" in fault.text


def test_motion_has_most_evidence_in_its_own_camera(lab: tuple[Observations, Truth]) -> None:
    fit = fit_jointly(turn_camera(*lab, camera=1, turn_rad=float(np.radians(0.2))))
    squares = sum_squares(fit)
    motions = [find_motion(squares, camera) for camera in range(3)]
    chi2 = [motion.chi2 if motion is not None else 0.0 for motion in motions]
    assert np.argmax(chi2) == 1


def test_marker_of_another_place_is_named(lab: tuple[Observations, Truth]) -> None:
    sightings = list(lab[0].sightings)
    own = sightings[2]
    pixels: Array = own.pixels.copy()
    pixels[4] += 60.0
    sightings[2] = replace(own, pixels=pixels)
    faults = find_faults(fit_jointly(replace(lab[0], sightings=tuple(sightings))))
    name = lab[0].points[int(own.point[4])].name
    assert any(name in fault.text for fault in faults)
