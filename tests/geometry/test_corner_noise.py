"""The propagated corner noise, compared with manual derivatives and with samples."""

import cv2
import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.vision.markers import check_covariance, pixel_slopes, whiten
from tests.geometry.squares import LENSES, Array


@pytest.mark.parametrize("model", LENSES)
def test_the_slopes_are_opencvs_derivative_by_the_shift(model: str) -> None:
    lens = LENSES[model]
    uv = np.random.default_rng(0).uniform((-0.6, -0.35), (0.6, 0.35), (20, 2))
    points, still = np.column_stack([uv, np.ones(20)]).reshape(-1, 1, 3), np.zeros(3)
    if model == "kannala_brandt":
        # Columns: f, c, k (4), rotation, shift, alpha.
        by_shift = cv2.fisheye.projectPoints(points, still, still, lens.K, lens.D)[1][:, 11:13]
    else:
        by_shift = cv2.projectPoints(points, still, still, lens.K, lens.D)[1][:, 3:5]
    np.testing.assert_allclose(pixel_slopes(uv, lens), by_shift.reshape(20, 2, 2), atol=1e-4)


def some_covariance(rank: int, seed: int = 0) -> Array:
    roots = np.random.default_rng(seed).normal(0, 0.03, (8, rank))
    return np.asarray(roots @ roots.T)


def test_whitened_noise_is_white() -> None:
    covariance = some_covariance(8)
    (whitening,) = whiten(covariance[None])
    np.testing.assert_allclose(whitening @ covariance @ whitening.T, np.eye(8), atol=1e-9)


def test_directions_without_noise_weigh_as_much_as_the_others() -> None:
    """A fitted pose gives corner covariances of rank 6, stored in single precision."""
    covariance = some_covariance(6).astype(np.float32).astype(np.float64)
    (whitening,) = whiten(covariance[None])
    # No number exceeds the limit by even the smallest noise.
    least = np.sqrt(np.linalg.eigvalsh(covariance)[2])
    assert np.linalg.norm(whitening, 2) == pytest.approx(1 / least)
    np.testing.assert_allclose(
        whitening @ covariance @ whitening.T, np.diag([0, 0, 1, 1, 1, 1, 1, 1]), atol=1e-3
    )


@pytest.mark.parametrize("covariance", [np.zeros((8, 8)), np.full((8, 8), np.nan), -np.eye(8)])
def test_invalid_covariance_is_reported(covariance: Array) -> None:
    with pytest.raises(IpsysError, match="marker 3 of camera red: covariance_px2 has no variance"):
        check_covariance(covariance, "marker 3 of camera red")
    check_covariance(some_covariance(6), "marker 3 of camera red")
