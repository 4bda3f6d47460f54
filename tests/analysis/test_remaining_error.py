"""The mean error after the stated error of the tape: its interval covers the truth."""

import numpy as np
import pytest

from ipsys_log.statistics.accuracy import error_statistics
from ipsys_log.statistics.remaining_error import with_remaining_error


def covered_share(points: int, cameras: int, model_m: float, tape_m: float) -> float:
    """Return the share of labs whose interval contains the true mean error."""
    covered = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        errors_m = model_m * (rng.standard_normal(2) + 0.5 * rng.standard_normal((points * cameras, 2)))
        tapes_m = np.tile(tape_m * rng.standard_normal((points, 2)), (cameras, 1))
        names = [f"p{n}" for n in range(points)] * cameras
        offsets_m = (errors_m - tapes_m)[None]
        statistics = error_statistics(np.linalg.norm(offsets_m, axis=2), points=names)
        spread_m2 = np.tile(tape_m**2 * np.eye(2), (len(names), 1, 1))
        found = with_remaining_error(statistics, offsets_m, spread_m2, np.zeros(len(names)), names)
        assert found.remaining_low_m is not None
        assert found.remaining_high_m is not None
        truth_m = np.linalg.norm(errors_m, axis=1).mean()
        covered.append(found.remaining_low_m <= truth_m <= found.remaining_high_m)
    return float(np.mean(covered))


@pytest.mark.parametrize(("points", "cameras"), [(6, 1), (17, 1), (8, 3)])
@pytest.mark.parametrize("model_m", [0.0003, 0.003, 0.01])
def test_interval_covers_true_error(points: int, cameras: int, model_m: float) -> None:
    assert covered_share(points, cameras, model_m, 0.003) >= 0.9


def test_error_of_tape_is_no_position_error() -> None:
    offsets_m = np.random.default_rng(0).normal(0.0, 0.003, (1, 400, 2))
    statistics = error_statistics(np.linalg.norm(offsets_m, axis=2))
    spread_m2 = np.tile(0.003**2 * np.eye(2), (400, 1, 1))
    found = with_remaining_error(
        statistics, offsets_m, spread_m2, np.zeros(400), [f"p{n}" for n in range(400)]
    )
    assert found.mean_m > 0.0035
    assert found.remaining_m is not None
    assert found.remaining_m < 0.0015


def test_unknown_tape_has_no_remaining_error() -> None:
    offsets_m = np.ones((1, 3, 2))
    statistics = error_statistics(np.linalg.norm(offsets_m, axis=2))
    found = with_remaining_error(statistics, offsets_m, np.zeros((3, 2, 2)), np.zeros(3), ["a", "b", "c"])
    assert found == statistics
