"""The field of the floor: its covariance, its slopes, and its edge."""

from __future__ import annotations

import numpy as np

from ipsys_log.calibration.joint.floor_field import make_floor_field

FIELD = make_floor_field(np.zeros(2), np.array([4.0, 3.0]), 0.002, 0.5)


def test_modes_have_the_covariance_of_the_kernel() -> None:
    rng = np.random.default_rng(1)
    points_m = rng.uniform(0, 3, (60, 2))
    modes = FIELD.modes(points_m)
    apart_m = np.linalg.norm(points_m[:, None] - points_m, axis=2)
    kernel = 0.002**2 * np.exp(-0.5 * (apart_m / 0.5) ** 2)
    assert np.abs(modes @ modes.T - kernel).max() < 0.02 * 0.002**2


def test_slopes_match_differences() -> None:
    rng = np.random.default_rng(2)
    points_m, amplitudes = rng.uniform(0.1, 2.9, (30, 2)), rng.standard_normal(FIELD.count)
    _, slopes = FIELD.heights(points_m, amplitudes)
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = 1e-6
        ahead, behind = (FIELD.heights(points_m + sign * step, amplitudes)[0] for sign in (1, -1))
        assert np.abs((ahead - behind) / 2e-6 - slopes[:, axis]).max() < 1e-8


def test_field_continues_beyond_its_edge() -> None:
    amplitudes = np.random.default_rng(3).standard_normal(FIELD.count)
    heights_m, slopes = FIELD.heights(np.array([[4.0, 1.0], [9.0, 1.0]]), amplitudes)
    assert abs(heights_m[1] - heights_m[0]) < 0.004
    assert slopes[1, 0] == 0.0


def test_flat_floor_has_no_modes() -> None:
    field = make_floor_field(np.zeros(2), np.ones(2), 0.0, 0.5)
    heights_m, slopes, modes = field.evaluate(np.array([[0.5, 0.5]]), np.zeros(0))
    assert (heights_m.tolist(), slopes.tolist(), modes.shape) == ([0.0], [[0.0, 0.0]], (1, 0))
