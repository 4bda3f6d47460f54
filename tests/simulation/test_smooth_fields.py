"""Random fields have the standard deviation and the correlation that they state."""

from __future__ import annotations

import numpy as np
import pytest

from tests.geometric.smooth_fields import SmoothField, SmoothSignal

FIELDS = 1500


def test_field_has_the_stated_rms_and_correlation() -> None:
    # The points are at arbitrary places between the nodes of the grid.
    points_m = np.array([[1.03, 2.2], [1.33, 2.6], [4.88, 0.0], [-0.4, 5.3]])
    rng = np.random.default_rng(1)
    drawn = np.array([SmoothField.draw(0.003, 0.5, 4.88, rng).at(points_m) for _ in range(FIELDS)])
    assert drawn.mean(axis=0) == pytest.approx(np.zeros(4), abs=4 * 0.003 / np.sqrt(FIELDS))
    assert drawn.std(axis=0) == pytest.approx(np.full(4, 0.003), rel=4 / np.sqrt(2 * FIELDS))
    correlation = np.corrcoef(drawn.T)
    assert correlation[0, 1] == pytest.approx(np.exp(-(0.5**2) / (2 * 0.5**2)), abs=4 / np.sqrt(FIELDS))
    assert abs(correlation[0, 2]) < 4 / np.sqrt(FIELDS)


def test_field_gradient_equals_its_differences() -> None:
    field = SmoothField.draw(0.003, 0.4, 4.88, np.random.default_rng(2))
    points_m, step_m = np.random.default_rng(3).uniform(0, 4.88, (50, 2)), 1e-5
    for axis in (0, 1):
        shift_m = step_m * np.eye(2)[axis]
        difference = (field.at(points_m + shift_m) - field.at(points_m - shift_m)) / (2 * step_m)
        assert field.gradient(points_m)[:, axis] == pytest.approx(difference, abs=1e-8)


def test_signal_has_the_stated_rms_and_correlation_time() -> None:
    rng = np.random.default_rng(4)
    times_s = np.array([0.0, 0.2, 7.77, 10.0])
    drawn = np.array([SmoothSignal.draw(0.01, 0.2, 10.0, 2, rng).at(times_s) for _ in range(FIELDS)])
    assert drawn.std(axis=0) == pytest.approx(np.full((4, 2), 0.01), rel=4.5 / np.sqrt(2 * FIELDS))
    assert np.corrcoef(drawn[:, 0, 0], drawn[:, 1, 0])[0, 1] == pytest.approx(np.exp(-0.5), abs=0.07)
    assert abs(np.corrcoef(drawn[:, 0, 0], drawn[:, 0, 1])[0, 1]) < 4 / np.sqrt(FIELDS)


def test_signal_is_smooth_between_its_nodes() -> None:
    signal = SmoothSignal.draw(1.0, 0.5, 20.0, 1, np.random.default_rng(5))
    values = signal.at(np.linspace(0, 20, 20_001))[:, 0]
    # The slope of such a signal has a standard deviation of rms / length.
    assert np.abs(np.diff(values)).max() < 6 * 1e-3 / 0.5
