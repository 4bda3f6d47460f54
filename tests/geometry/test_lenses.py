"""Lenses compared with the formulas of their models, written out here."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration
from ipsys_log.vision.lenses import check_calibration, project, same_intrinsics, undistort

FISHEYE = (-0.1305, 0.0119, -0.0310, 0.0168)
PINHOLE = (-0.33, 0.046, -0.0043, 0.0041, 0.0666)
RATIONAL = (0.2, 0.05, 0.001, -0.002, 0.01, 0.3, 0.04, 0.002)


def lens(model: str, d: tuple[float, ...]) -> CameraCalibration:
    k = np.array([[1151.6, 0, 932.9], [0, 1148.8, 504.3], [0, 0, 1]])
    p = np.hstack([k, np.zeros((3, 1))])
    return CameraCalibration(0, "a", 1920, 1080, model, np.array(d), k, np.eye(3), p)


def kannala_brandt(point: tuple[float, float, float]) -> tuple[float, float]:
    """Project with the fisheye formula of OpenCV's documentation."""
    x, y, z = point
    r = np.hypot(x, y) / z
    theta = np.arctan(r)
    k1, k2, k3, k4 = FISHEYE
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    scale = bent / r if r > 0 else 1.0
    return 1151.6 * scale * x / z + 932.9, 1148.8 * scale * y / z + 504.3


points = st.tuples(st.floats(-2.2, 2.2), st.floats(-1.1, 1.1), st.floats(1.5, 3.0))


@given(points)
def test_the_fisheye_projection_is_the_formula(point: tuple[float, float, float]) -> None:
    pixel = project(np.array([point]), lens("kannala_brandt", FISHEYE))[0]
    np.testing.assert_allclose(pixel, kannala_brandt(point), atol=1e-9)


@given(points)
def test_undistort_solves_the_formula(point: tuple[float, float, float]) -> None:
    fisheye = lens("kannala_brandt", FISHEYE)
    pixel = np.array([kannala_brandt(point)])
    k1, k2, k3, k4 = FISHEYE
    a, b = (pixel[0, 0] - 932.9) / 1151.6, (pixel[0, 1] - 504.3) / 1148.8
    bent = float(np.hypot(a, b))
    theta = brentq(
        lambda t: t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) - bent, 0, 1.2, xtol=1e-15
    )
    scale = np.tan(theta) / bent if bent > 1e-12 else 1.0
    np.testing.assert_allclose(undistort(pixel, fisheye)[0], (a * scale, b * scale), atol=1e-9)


@pytest.mark.parametrize(
    ("model", "d"), [("kannala_brandt", FISHEYE), ("plumb_bob", PINHOLE), ("rational_polynomial", RATIONAL)]
)
def test_undistort_is_the_inverse_of_project(model: str, d: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    uv = rng.uniform((-0.7, -0.4), (0.7, 0.4), (200, 2))
    seen = project(np.column_stack([uv, np.ones(200)]) * 2.1, lens(model, d))
    np.testing.assert_allclose(undistort(seen, lens(model, d)), uv, atol=1e-8)
    assert project(np.zeros((0, 3)), lens(model, d)).shape == (0, 2)
    assert undistort(np.zeros((0, 2)), lens(model, d)).shape == (0, 2)


@pytest.mark.parametrize(
    ("model", "d", "said"),
    [
        ("equidistant", FISHEYE, "'equidistant' is not known"),
        ("kannala_brandt", PINHOLE, "takes 4 coefficients, found 5"),
        ("plumb_bob", (0.0, 0.0, 0.0, 0.0, np.nan), "are not valid"),
    ],
)
def test_unusable_calibration_is_refused(model: str, d: tuple[float, ...], said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        check_calibration(lens(model, d), "calibration of red")


def test_lens_equality_compares_the_distortion() -> None:
    assert same_intrinsics(lens("kannala_brandt", FISHEYE), lens("kannala_brandt", FISHEYE))
    assert not same_intrinsics(lens("kannala_brandt", FISHEYE), lens("kannala_brandt", (0.0, *FISHEYE[1:])))


@pytest.mark.parametrize(
    ("model", "d"), [("kannala_brandt", FISHEYE), ("plumb_bob", PINHOLE), ("rational_polynomial", RATIONAL)]
)
def test_projection_of_no_points_is_empty(model: str, d: tuple[float, ...]) -> None:
    assert project(np.zeros((0, 3)), lens(model, d)).shape == (0, 2)
