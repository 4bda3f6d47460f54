"""Poses between the rows of a track agree with the integral of the assumed motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipsys_log.messages import Message, Track, Tracks
from ipsys_log.models.tracking.motion import MotionNoise
from ipsys_log.models.tracking.track_messages import TrackRows, gather_rows, interpolate

Array = NDArray[np.float64]

NOISE = MotionNoise()
ROW_M2, RATE_M2_S2 = 1e-6 * np.diag([1.0, 2.0, 3.0]), 1e-4 * np.eye(3)


def make_rows(times_ns: list[int], exact: bool = False) -> TrackRows:
    """Return rows of a robot on the parabola x = t^2, y = 1 - t that turns by 0.5 rad/s."""
    times_s = np.array(times_ns) / 1e9
    count, scale = len(times_ns), 0.0 if exact else 1.0
    return TrackRows(
        np.array(times_ns, dtype=np.int64),
        np.zeros(count, dtype=np.int64),
        np.stack([times_s**2, 1 - times_s, 0.1 + 0 * times_s], axis=1),
        scale * np.broadcast_to(ROW_M2, (count, 3, 3)),
        np.stack([2 * times_s, -1 + 0 * times_s, 0 * times_s], axis=1),
        scale * np.broadcast_to(RATE_M2_S2, (count, 3, 3)),
        (3.0 + 0.5 * times_s + np.pi) % (2 * np.pi) - np.pi,
        np.full(count, scale * 0.001),
        np.full(count, 0.5),
        np.zeros(count),
    )


def test_sample_at_a_row_is_the_row() -> None:
    rows = make_rows([0, 11_000_000, 400_000_000])
    samples = interpolate(rows, rows.times_ns, NOISE)
    assert np.array_equal(samples.points_m, rows.points_m)
    assert np.array_equal(samples.velocities_m_s, rows.velocities_m_s)
    np.testing.assert_allclose(samples.covariances_m2, rows.covariances_m2, rtol=1e-12)
    np.testing.assert_allclose(samples.headings_rad, rows.headings_rad)


@given(st.lists(st.integers(0, 900_000_000), min_size=1, max_size=5))
def test_constant_acceleration_is_followed_exactly(times_ns: list[int]) -> None:
    rows, wanted_ns = make_rows([0, 30_000_000, 900_000_000]), np.array(times_ns, dtype=np.int64)
    samples, exact = interpolate(rows, wanted_ns, NOISE), make_rows(times_ns)
    np.testing.assert_allclose(samples.points_m, exact.points_m, atol=1e-12)
    np.testing.assert_allclose(samples.velocities_m_s, exact.velocities_m_s, atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * samples.headings_rad), np.exp(1j * exact.headings_rad), atol=1e-9)


def test_instants_outside_of_tracks_are_nan() -> None:
    rows = replace(make_rows([100, 200, 300, 400]), numbers=np.array([0, 0, 1, 1]))
    samples = interpolate(rows, np.array([99, 100, 150, 200, 250, 300, 400, 401]), NOISE)
    known = [False, True, True, True, False, True, True, False]
    assert np.isfinite(samples.points_m).all(axis=1).tolist() == known
    assert np.isfinite(samples.covariances_m2).all(axis=(1, 2)).tolist() == known
    assert np.isfinite(samples.headings_rad).tolist() == known
    nothing = interpolate(make_rows([]), np.array([5]), NOISE)
    assert np.isnan(nothing.points_m).all()


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_vertical_uncertainty_equals_the_spline_of_white_noise(share: float) -> None:
    # Between two known states, white acceleration of density q gives q s^3 (T - s)^3 / (3 T^3).
    whole_s = 0.7
    rows = make_rows([0, 700_000_000], exact=True)
    samples = interpolate(rows, np.array([round(share * 700_000_000)]), NOISE)
    elapsed_s = share * whole_s
    shape = (elapsed_s * (whole_s - elapsed_s)) ** 3 / (3 * whole_s**3)
    assert samples.covariances_m2[0, 2, 2] == pytest.approx(NOISE.climb_m_s2**2 * shape, rel=1e-6)
    assert samples.heading_sigmas_rad[0] ** 2 == pytest.approx(NOISE.turn_rad_s2**2 * shape, rel=1e-6)


@pytest.mark.parametrize(("share", "with_rates"), [(0.25, True), (0.5, True), (0.5, False)])
def test_unknown_motion_equals_its_integral(share: float, with_rates: bool) -> None:
    """Integrate the covariance of the acceleration over the kernel of the interpolation (Peano)."""
    whole_s = 0.5
    elapsed_s, u = share * whole_s, share
    times_s = np.linspace(0, whole_s, 4001)
    left = np.maximum(elapsed_s - times_s, 0.0)
    if with_rates:
        kernel = left - u**2 * (3 - 2 * u) * (whole_s - times_s) - whole_s * u**2 * (u - 1)
    else:
        kernel = left - u * (whole_s - times_s)
    weights = np.full(len(times_s), times_s[1])
    weights[[0, -1]] /= 2
    apart_s = np.abs(times_s[:, None] - times_s)
    rows = make_rows([0, 500_000_000], exact=True)
    speed_m_s = np.linalg.norm(np.diff(rows.points_m, axis=0)) / whole_s
    variance = NOISE.acceleration_m_s2**2 + (NOISE.bend_rad_s * speed_m_s) ** 2
    expected_m2 = (kernel * weights) @ (variance * np.exp(-apart_s / NOISE.hold_s)) @ (kernel * weights)
    if not with_rates:
        missing = np.full_like(rows.velocities_m_s, np.nan)
        rows = replace(rows, velocities_m_s=missing, velocity_covariances_m2_s2=np.full((2, 3, 3), np.nan))
    samples = interpolate(rows, np.array([round(share * 500_000_000)]), NOISE)
    assert samples.covariances_m2[0, 0, 0] == pytest.approx(expected_m2, rel=1e-3)
    assert np.isnan(samples.velocities_m_s).all() == (not with_rates)


def test_covariance_between_rows_is_at_least_that_of_the_rows() -> None:
    samples = interpolate(make_rows([0, 300_000_000]), np.arange(0, 300_000_001, 10_000_000), NOISE)
    variances = np.diagonal(samples.covariances_m2, axis1=1, axis2=2)
    assert (variances >= np.diagonal(ROW_M2) * (1 - 1e-12)).all()
    middle = len(variances) // 2
    assert (variances[middle, :2] > 1.5 * np.diagonal(ROW_M2)[:2]).all()


def message(time_ns: int, *tracks: Track) -> Message:
    return Message("/runs/poly/tracks", time_ns, time_ns, Tracks(time_ns, tracks))


def test_rows_of_a_robot_are_divided_into_its_tracks() -> None:
    def ada(age_ns: int | None, x_m: float = 0.0) -> Track:
        return Track("ada", 1, x_m, 0.0, 0.0, age_ns=age_ns)

    messages = [
        message(300, ada(200)),
        message(100, ada(0)),
        message(400, ada(50)),
        message(350, ada(0, 7.0)),
    ]
    messages += [message(2_000_000_000, ada(None), Track("bob", 2, 0.0, 0.0, 0.0)), message(350, ada(0, 9.0))]
    rows, robots = gather_rows(messages, "ada")
    assert robots == {"ada", "bob"}
    assert rows.times_ns.tolist() == [100, 300, 350, 400, 2_000_000_000]
    assert rows.numbers.tolist() == [0, 0, 1, 1, 2]
    assert rows.points_m[2, 0] == 9.0
