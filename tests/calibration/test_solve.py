"""Known intrinsics estimated from noisy corners, and their errors compared with the standard deviations."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.calibration.bundle_adjustment import Corners, adjust
from ipsys_log.calibration.lens_models import LENS_MODELS
from ipsys_log.calibration.solve import SolveResult, find_start, fitted_basis, pose_from_rays, solve
from tests.calibration.boards_seen import SIZE_PX, TRUTH, grid_m, random_pose, seen
from tests.tiers import first_fast


def squared_errors(name: str, seeds: range, shared_px: float = 0.0) -> NDArray[np.float64]:
    """Return squared errors in units of the estimated variance, (seeds, parameters)."""
    rows = []
    for seed in seeds:
        found = solve(
            LENS_MODELS[name], seen(name, np.random.default_rng(seed), shared_px=shared_px), SIZE_PX
        )
        variance = np.diag(found.covariance)
        fitted = variance > 0
        rows.append((found.fit.intrinsics - TRUTH[name])[fitted] ** 2 / variance[fitted])
    return np.array(rows)


@pytest.mark.parametrize("name", first_fast(2, list(TRUTH)))
def test_known_intrinsics_are_recovered_within_their_sigma(name: str) -> None:
    """With 8 seeds and about 8 correlated parameters, the mean square is 1 within a factor of two."""
    errors = squared_errors(name, range(8))
    assert 0.5 < errors.mean() < 2.0, errors.mean(axis=0)
    assert (errors < 4).mean() > 0.85
    assert errors.max() < 30


@pytest.mark.parametrize("name", ["fisheye", "pinhole"])
def test_sigma_includes_errors_shared_by_an_image(name: str) -> None:
    """With residuals taken as independent, these squares would be 2 on average."""
    errors = squared_errors(name, range(8), shared_px=0.15)
    assert 0.4 < errors.mean() < 1.6, errors.mean(axis=0)


def test_more_noise_is_more_uncertainty() -> None:
    sigmas = []
    for noise_px in (0.05, 0.5):
        corners = seen("pinhole", np.random.default_rng(0), noise_px=noise_px)
        sigmas.append(np.sqrt(np.diag(solve(LENS_MODELS["pinhole"], corners, SIZE_PX).covariance)))
    np.testing.assert_allclose(sigmas[1] / sigmas[0], 10, rtol=0.5)


def test_opencv_finds_the_same_pinhole() -> None:
    """On the same corners of a flat board, plain least squares have the same minimum."""
    model, corners = LENS_MODELS["pinhole"], seen("pinhole", np.random.default_rng(3))
    start = find_start(model, corners, SIZE_PX)
    fit = adjust(model, start, corners, fitted_basis(model, square=True), None)
    bounds = [*corners.starts, len(corners.image_numbers)]
    boards = [corners.board_m[a:b].astype(np.float32) for a, b in pairwise(bounds)]
    pixels = [corners.pixels[a:b].astype(np.float32) for a, b in pairwise(bounds)]
    guess = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_USE_INTRINSIC_GUESS
    _, k, d, _, _ = cv2.calibrateCamera(boards, pixels, SIZE_PX, guess, np.zeros(5), flags=flags)
    theirs = np.concatenate([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]], np.ravel(d)[:5]])
    np.testing.assert_allclose(fit.intrinsics, theirs, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("name", ["fisheye", "pinhole"])
def test_bent_board_gives_its_bending_and_true_intrinsics(name: str) -> None:
    """Taken as flat, the board gives the pinhole a focal length that is 1.7 % too short, 7 sigmas."""
    corners = seen(name, np.random.default_rng(1), noise_px=0.05, bending_m=0.0005)
    found = solve(LENS_MODELS[name], corners, SIZE_PX)
    errors = (found.fit.intrinsics - TRUTH[name]) / np.sqrt(np.diag(found.covariance))
    assert (np.abs(errors) < 3).all()
    assert (np.abs(found.fit.bending_m - (0.0005, 0.0)) < 3 * found.bending_sigma_m).all()
    assert (found.bending_sigma_m < 0.0001).all()


def test_pixels_that_are_not_square() -> None:
    stretched = (600.0, 642.0, *TRUTH["pinhole"][2:])
    corners = seen("pinhole", np.random.default_rng(0), lens=stretched)
    found = solve(LENS_MODELS["pinhole"], corners, SIZE_PX)
    assert not found.square
    sigmas = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.fit.intrinsics - stretched) < 4 * sigmas).all()


def test_almost_square_pixels_are_recognised() -> None:
    """The pixels differ from squares by half a per cent, in images that are good enough to show it."""
    stretched = (600.0, 603.0, *TRUTH["pinhole"][2:])
    corners = seen("pinhole", np.random.default_rng(0), noise_px=0.03, lens=stretched)
    found = solve(LENS_MODELS["pinhole"], corners, SIZE_PX)
    assert not found.square
    assert np.sqrt((found.residuals_px**2).sum(axis=1).mean()) < 0.05


def test_foreign_image_is_found_with_non_square_pixels() -> None:
    """With pixels assumed square, all images have errors, so one more is not noticed."""
    stretched = (600.0, 618.0, *TRUTH["pinhole"][2:])
    corners = seen("pinhole", np.random.default_rng(0), lens=stretched)
    corners.pixels[corners.image_numbers == 12] += np.random.default_rng(9).normal(0, 0.6, (24, 2))
    found = solve(LENS_MODELS["pinhole"], corners, SIZE_PX)
    assert [left.number for left in found.excluded] == [12]
    assert (np.abs(found.fit.intrinsics - stretched) < 4 * np.sqrt(np.diag(found.covariance))).all()


def spoiled(corners: Corners) -> Corners:
    """Ten corners have errors of 5 to 20 px, and one image shows another print."""
    rng = np.random.default_rng(9)
    pixels = corners.pixels.copy()
    pixels[rng.choice(200, 10, replace=False)] += rng.uniform(5, 20, (10, 2))
    pixels[corners.image_numbers == 12] += rng.normal(0, 2.0, (24, 2))
    return Corners(corners.board_m, pixels, corners.image_numbers, corners.image_count)


@pytest.mark.parametrize("name", ["fisheye", "pinhole"])
def test_foreign_images_are_excluded_and_reported(name: str) -> None:
    found = solve(LENS_MODELS[name], spoiled(seen(name, np.random.default_rng(5))), SIZE_PX)
    assert [left.number for left in found.excluded] == [12]
    assert "does not fit" in found.excluded[0].reason or "wrong corners" in found.excluded[0].reason
    assert found.outlier_corners == 10
    assert within(found, name)


def within(found: SolveResult, name: str) -> bool:
    sigmas = np.sqrt(np.diag(found.covariance))
    return bool((np.abs(found.fit.intrinsics - TRUTH[name]) <= 4 * sigmas).all())


@pytest.mark.parametrize("focal_px", [90.0, 185.0, 400.0])
def test_fisheye_needs_no_initial_focal_length(focal_px: float) -> None:
    lens = (focal_px, focal_px, *TRUTH["fisheye"][2:])
    corners = seen("fisheye", np.random.default_rng(1), pictures=15, lens=lens)
    start = find_start(LENS_MODELS["fisheye"], corners, SIZE_PX)
    np.testing.assert_allclose(start.intrinsics[:4], lens[:4], rtol=0.02)


def test_a_pose_follows_from_rays_beyond_90_degrees() -> None:
    board_m = grid_m()
    for seed in range(20):
        turn, place_m = random_pose(np.random.default_rng(seed), "fisheye")
        turn, place_m = np.diag([1.0, -1.0, -1.0]) @ turn, np.diag([1.0, -1.0, -1.0]) @ place_m
        points = board_m @ turn.T + place_m
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        found_turn, found_m = pose_from_rays(board_m, rays)
        np.testing.assert_allclose(found_m, place_m, atol=1e-9)
        np.testing.assert_allclose(found_turn, turn, atol=1e-9)
