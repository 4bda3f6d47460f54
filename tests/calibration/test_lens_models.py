"""Projections compared with OpenCV and with the written formulas, and derivatives with differences."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.calibration.lens_models import (
    LENS_MODELS,
    find_lens_model,
    project_points,
    project_with_slopes,
)
from ipsys_log.errors import IpsysError
from tests.calibration.boards_seen import TRUTH, pixels_of

STILL = np.zeros(3)


def points(seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.6, 0.6, (50, 2)), rng.uniform(0.6, 2.0, 50)])


@pytest.mark.parametrize("name", list(LENS_MODELS))
def test_pixels_are_those_of_opencv(name: str) -> None:
    lens = np.array(TRUTH[name])
    k = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    expected, _ = project(points().reshape(-1, 1, 3), STILL, STILL, k, lens[4:])
    pixels = project_points(LENS_MODELS[name], lens, points())
    np.testing.assert_allclose(pixels, np.reshape(expected, (-1, 2)), atol=1e-9)


def test_a_fisheye_sees_what_is_beside_and_behind_it() -> None:
    beyond = points() * (1.0, 1.0, -0.3)
    pixels = project_points(LENS_MODELS["fisheye"], np.array(TRUTH["fisheye"]), beyond)
    np.testing.assert_allclose(pixels, pixels_of("fisheye", TRUTH["fisheye"], beyond), atol=1e-9)
    # Farther from the principal point than any point in front of the camera.
    middle = TRUTH["fisheye"][2:4]
    assert np.linalg.norm(pixels - middle, axis=1).min() > 185 * np.pi / 2 * 0.9


@pytest.mark.parametrize("name", list(LENS_MODELS))
def test_derivatives(name: str) -> None:
    model, lens, here = LENS_MODELS[name], np.array(TRUTH[name]), points(1)
    if name == "fisheye":
        here[:10, 2] *= -1
    _, by_point, by_lens = project_with_slopes(model, lens, here)
    step = 1e-6
    for n, axis in enumerate(np.eye(3) * step):
        ahead, behind = (project_points(model, lens, here + sign * axis) for sign in (1, -1))
        np.testing.assert_allclose(by_point[:, :, n], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-4)
    for n, axis in enumerate(np.eye(lens.size) * step):
        ahead, behind = (project_points(model, lens + sign * axis, here) for sign in (1, -1))
        np.testing.assert_allclose(by_lens[:, :, n], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-4)


def test_optical_axis_projects_to_the_principal_point() -> None:
    pixels, by_point, _ = project_with_slopes(
        LENS_MODELS["fisheye"], np.array(TRUTH["fisheye"]), np.array([[0.0, 0.0, 2.0]])
    )
    np.testing.assert_allclose(pixels[0], TRUTH["fisheye"][2:4])
    np.testing.assert_allclose(by_point[0, :, :2], np.eye(2) * 185.0 / 2.0, atol=1e-6)


def test_missing_calibration_is_refused() -> None:
    with pytest.raises(IpsysError, match="use one of fisheye, pinhole"):
        find_lens_model("omni")
