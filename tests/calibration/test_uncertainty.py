"""Uncertainties with few images, and of lenses outside the fitted model, compared with the ground truth."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.calibration.lens_models import LENS_MODELS
from ipsys_log.calibration.solve import solve
from tests.calibration.boards_seen import SIZE_PX, TRUTH, seen

# A lens with decentred elements: the fisheye model has no terms for it.
DECENTERED = (600.0, 600.0, 330.0, 230.0, -0.25, 0.1, 0.004, -0.006, -0.02)


def squared_errors(
    true: str, fitted: str, pictures: int, seeds: range, lens: tuple[float, ...] | None = None
) -> NDArray[np.float64]:
    """Return squared errors of focal length and principal point in units of the variance, (seeds, 3)."""
    rows = []
    for seed in seeds:
        corners = seen(true, np.random.default_rng(seed), pictures, lens=lens)
        solved = solve(LENS_MODELS[fitted], corners, SIZE_PX)
        errors = solved.fit.intrinsics - np.pad(lens or TRUTH[true], (0, 99))[: len(solved.fit.intrinsics)]
        rows.append((errors**2 / np.diag(solved.covariance).clip(1e-12))[[0, 2, 3]])
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fisheye", "pinhole8"])
def test_few_pictures_errors_are_as_stated(name: str) -> None:
    """Seven images may agree by chance; the error of a jackknife of seven is then up to 6 sigma."""
    errors = squared_errors(name, name, 7, range(100, 130))
    assert 0.2 < errors.mean() < 1.3, errors.mean(axis=0)
    assert (errors < 4).mean() >= 0.93
    assert errors.max() < 3.5**2


@pytest.mark.slow
def test_lens_of_other_kind_errors_are_as_stated() -> None:
    """With the jackknife only, the mean is 3 to 4 for 20 images."""
    errors = squared_errors("pinhole", "fisheye", 20, range(100, 120), DECENTERED)
    assert 0.3 < errors.mean() < 2.0, errors.mean(axis=0)
    assert (errors < 4).mean() >= 0.9


@pytest.mark.slow
def test_lens_of_the_right_kind_is_stated_no_worse() -> None:
    """With twenty images, the effect of a richer model is noise and has little weight."""
    errors = squared_errors("fisheye", "fisheye", 20, range(100, 120))
    assert errors.mean() > 0.5
