"""Observations that cannot determine a lab are refused with a sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.fit import explain_divergence, fit_jointly
from ipsys_log.calibration.joint.observations import Observations, marker_body
from ipsys_log.calibration.joint.solver import ConvergenceError
from ipsys_log.errors import FitError
from tests.joint.small_lab import make_lab


def keep_points(observations: Observations, keep: set[int]) -> Observations:
    """Return the observations with the tape readings of some points alone."""
    none = np.zeros(0)
    return replace(
        observations,
        points=tuple(
            point
            if number in keep
            else replace(
                point,
                references_m=np.zeros((0, 2)),
                distances_m=none,
                distance_sigmas_m=none,
                start_m=None,
            )
            for number, point in enumerate(observations.points)
        ),
    )


def test_camera_without_overlap_and_tape_is_refused() -> None:
    observations, _ = make_lab(1, points=16)
    first, second = (set(one.point.tolist()) for one in observations.sightings)
    alone = np.array([number not in first for number in observations.sightings[1].point.tolist()])
    cut = replace(
        observations, sightings=(observations.sightings[0], observations.sightings[1].select(alone))
    )
    assert second - first
    with pytest.raises(FitError, match="camera c1: it sees fewer than two measured points, and no marker"):
        fit_jointly(keep_points(cut, first))


def test_points_on_a_line_have_a_covariance_that_holds() -> None:
    """Each marker shows its own tilt, so that points on a line determine a camera, if not well."""
    observations, truth = make_lab(1, points=40, cameras=1)
    own = observations.sightings[0]
    places_m = np.array([observations.points[number].start_m for number in own.point.tolist()])
    row = np.abs(places_m[:, 1] - np.median(places_m[:, 1])) < 0.1
    assert row.sum() > 3
    fit = fit_jointly(replace(observations, sightings=(own.select(row),)))
    origin = slice(3, 6)
    true_m = -truth.camera_from_world[0][:3, :3].T @ truth.camera_from_world[0][:3, 3]
    error_m = fit.state.values[origin] - true_m
    assert error_m @ np.linalg.solve(fit.covariance[origin, origin], error_m) < 16.3


def test_one_measured_point_is_refused() -> None:
    observations, _ = make_lab(1, points=6)
    with pytest.raises(FitError, match="1 measured points; measure at least two"):
        fit_jointly(keep_points(observations, {2}))


def test_unknown_length_is_refused() -> None:
    observations, _ = make_lab(1, points=6)
    unknown = replace(observations, bodies=(marker_body("0", 0.2, np.inf),))
    with pytest.raises(FitError, match="no length is known"):
        fit_jointly(keep_points(unknown, set()))


def test_camera_without_sightings_is_refused() -> None:
    observations, _ = make_lab(1, points=6)
    first, second = observations.sightings
    empty = second.select(np.zeros(len(second), dtype=bool))
    with pytest.raises(FitError, match="camera c1: it saw no marker"):
        fit_jointly(replace(observations, sightings=(first, empty)))


def test_camera_that_nothing_holds_is_named() -> None:
    """All sightings of the camera count as outliers, so the fit can move it without limit."""
    observations, _ = make_lab(1, points=8)
    fit = fit_jointly(observations)
    values = fit.state.values.copy()
    values[fit.problem.layout.cameras[1].start + 3] += 1000.0
    error = ConvergenceError("no convergence", fit.problem, replace(fit.state, values=values))
    count = len(observations.sightings[1])
    assert f"no sighting of camera c1 ({count} sightings) fits" in str(
        explain_divergence(error, observations)
    )
    held = ConvergenceError("no convergence", fit.problem, fit.state)
    assert str(explain_divergence(held, observations)) == "no convergence"
