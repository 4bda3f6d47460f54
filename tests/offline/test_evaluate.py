"""Errors by eq. (26) and (27), and of tracks against the truth."""

from __future__ import annotations

import statistics

import numpy as np
import pytest

from ipsys_log.messages import Message, Pair, Track, Tracks
from ipsys_log.offline.evaluate import error_statistics, evaluate_model, gather_tracks, track_errors
from ipsys_log.offline.fit import fit_model

POINTS = np.random.default_rng(0).uniform((-2, -1, 1.9), (2, 1, 2.1), (14, 3))


def pairs(offset: np.ndarray) -> list[Pair]:
    return [Pair(f"m{n}", 0, point, point + offset, 1) for n, point in enumerate(POINTS)]


def test_statistics_are_those_of_the_standard_library() -> None:
    errors = [0.01, 0.025, 0.013, 0.07]
    found = error_statistics(np.array(errors))
    assert found.count == 4
    assert found.mean_m == pytest.approx(statistics.mean(errors))
    assert found.std_m == pytest.approx(statistics.stdev(errors))
    assert (found.min_m, found.max_m) == (0.01, 0.07)
    assert error_statistics(np.array([0.01])).std_m is None


def test_errors_in_space_and_on_the_floor() -> None:
    model = fit_model("rigid", {"red": pairs(np.zeros(3))}, 0)
    evaluation = evaluate_model(model, {"red": pairs(np.array([0.03, 0.04, 0.12]))}, {}, 0)
    (row,) = evaluation.cameras
    assert row.against == "tape"
    assert row.error_3d.mean_m == pytest.approx(0.13)
    assert row.error_2d.mean_m == pytest.approx(0.05)


def test_the_truth_is_compared_where_it_is_known() -> None:
    model = fit_model("rigid", {"red": pairs(np.zeros(3))}, 0)
    truth = {"m0": POINTS[0], "m5": POINTS[5] + [0, 0, 0.01]}
    rows = {row.against: row for row in evaluate_model(model, {"red": pairs(np.ones(3))}, truth, 0).cameras}
    assert rows["truth"].error_3d.count == 2
    assert rows["truth"].error_3d.max_m == pytest.approx(0.01)
    assert rows["tape"].error_3d.count == 14


def test_a_camera_without_held_out_places_has_no_row() -> None:
    model = fit_model("rigid", {"red": pairs(np.zeros(3)), "white": pairs(np.zeros(3))}, 0)
    evaluation = evaluate_model(model, {"white": pairs(np.ones(3))}, {}, 0)
    assert [row.camera for row in evaluation.cameras] == ["white"]


def test_the_covariance_is_of_errors_that_the_fit_has_not_seen() -> None:
    rng = np.random.default_rng(1)
    noisy = [
        Pair(p.measurement, 0, p.camera_m, p.world_m + rng.normal(0, 0.01, 3), 1) for p in pairs(np.zeros(3))
    ]
    covariance = fit_model("poly", {"red": noisy}, 0).cameras[0].covariance_m2
    assert covariance is not None
    # With 14 pairs for 10 parameters the fit looks good and is not.
    assert np.sqrt(np.trace(covariance) / 3) > 0.015
    assert fit_model("poly", {"red": noisy[:10]}, 0).cameras[0].covariance_m2 is None


def tracked(time_ns: int, x_m: float) -> Message:
    return Message("t", time_ns, time_ns, Tracks(time_ns, (Track("robot_0", 0, x_m, 0.0, 0.0),)))


def test_the_last_pose_of_an_instant_counts() -> None:
    truth = gather_tracks([tracked(1, 0.0), tracked(2, 1.0)])
    tracks = gather_tracks([tracked(1, 0.5), tracked(1, 0.01), tracked(2, 1.02), tracked(3, 9.0)])
    found = track_errors(tracks, truth)
    assert found is not None
    assert found[0].count == 2
    assert found[0].mean_m == pytest.approx(0.015)
    assert track_errors(tracks, {}) is None


def test_places_that_the_model_was_fitted_on_are_not_held_out() -> None:
    """As where a model is applied to the very log that it was made from."""
    model = fit_model("rigid", {"red": pairs(np.zeros(3))}, 0)
    assert evaluate_model(model, {"red": pairs(np.zeros(3))}, {}, 0).cameras == ()
