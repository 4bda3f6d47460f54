"""Scores of a robot's estimate by closed forms: coverage, drift, NEES and the part of the tracks."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log import IpsysError
from ipsys_log.models.tracking.track_messages import TrackRows
from ipsys_log.statistics.estimate_scores import EstimateFrame, EstimateScore, score_estimate
from ipsys_log.units import NS_PER_S

Array = NDArray[np.float64]

TIMES_S = np.arange(900) / 30
LAB = EstimateFrame(0.0, np.zeros(3), 1.0, np.zeros(3), 0.0)


def straight(
    times_s: Array = TIMES_S, sigma_m: float = np.nan, heading_sigma_rad: float = np.nan
) -> TrackRows:
    """Return a drive of 0.5 m/s along x, with independent errors of x and y."""
    count = len(times_s)
    nothing, none = np.full((count, 3), np.nan), np.full(count, np.nan)
    covariances_m2 = np.tile(np.diag([sigma_m**2, sigma_m**2, 0 * sigma_m]), (count, 1, 1))
    return TrackRows(
        (times_s * NS_PER_S).astype(np.int64),
        np.zeros(count, np.int64),
        np.column_stack([0.5 * times_s, np.zeros(count), np.zeros(count)]),
        covariances_m2,
        nothing,
        np.full((count, 3, 3), np.nan),
        np.zeros(count),
        np.full(count, heading_sigma_rad),
        none,
        none,
    )


def score(estimate: TrackRows, tracks: TrackRows, frame: EstimateFrame = LAB) -> EstimateScore:
    return score_estimate(estimate, tracks, frame, False, "odom.tum")


def test_missing_part_of_a_drive_is_counted() -> None:
    found = score(straight(TIMES_S[(TIMES_S < 10) | (TIMES_S >= 15)]), straight())
    assert found.coverage.time_share == pytest.approx(25 / 30, abs=0.01)
    assert found.coverage.area_share == pytest.approx(25 / 30, abs=0.01)
    assert (found.coverage.gaps, len(found.times_ns)) == (1, 750)
    assert found.coverage.longest_gap_s == pytest.approx(5.0, abs=0.1)


def test_drift_is_the_share_of_the_distance() -> None:
    estimate = straight()
    estimate.points_m[:, 0] *= 1.02
    found = score(estimate, straight()).drift
    assert found is not None
    assert found.delta == 5.0
    assert np.abs(found.errors_m / found.delta - 0.02).max() < 0.0005


def test_part_of_the_tracks_has_the_lever_of_the_pivot() -> None:
    frame = LAB._replace(pivot_m=np.array([0.5, 0.0, 0.0]))
    estimate = straight()
    estimate.points_m[:, 0] += 0.5
    found = score(estimate, straight(sigma_m=0.01, heading_sigma_rad=0.02), frame)
    assert found.tracks_m == pytest.approx(np.sqrt(2 * 0.01**2 + 0.01**2), rel=1e-6)
    assert np.abs(found.after("none").errors.offsets_m).max() < 1e-12


@pytest.mark.parametrize(("sigma_m", "nees"), [(0.01, 1.0), (0.005, 4.0), (np.nan, None)])
def test_nees_shows_whether_covariances_hold(sigma_m: float, nees: float | None) -> None:
    estimate = straight(sigma_m=sigma_m)
    estimate.points_m[1:, :2] += np.random.default_rng(1).normal(0, 0.01, (len(TIMES_S) - 1, 2))
    estimate.covariances_m2[0] = 0 * estimate.covariances_m2[0]
    found = score(estimate, straight(sigma_m=1e-6))
    assert found.nees == (None if nees is None else pytest.approx(nees, rel=0.1))


def test_estimate_at_other_times_is_refused() -> None:
    with pytest.raises(IpsysError, match="fewer than 3 poses are at the times of the tracks"):
        score(straight(TIMES_S + 100), straight())
