"""Eq. (3) to (5) compared with a marker at a known position."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ipsys_log.vision.markers import camera_point, camera_point_slopes, heading, marker_corners


def seen(centre: tuple[float, float, float], angle_rad: float, length_m: float) -> np.ndarray:
    """Return normalized corners of a marker parallel to the image plane, facing the camera."""
    # The marker's y is up and the camera's y is down: a half turn about x, then the angle about z.
    turn = Rotation.from_euler("z", angle_rad) * Rotation.from_euler("x", np.pi)
    corners = turn.apply(marker_corners(length_m)) + np.array(centre)
    return np.asarray(corners[:, :2] / corners[:, 2:])


places = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.5, 4))


@given(places, st.floats(-3, 3), st.floats(0.05, 0.5))
def test_a_parallel_marker_is_found_exactly(
    centre: tuple[float, float, float], angle_rad: float, length_m: float
) -> None:
    uv = seen(centre, angle_rad, length_m)
    np.testing.assert_allclose(camera_point(uv, length_m), centre, atol=1e-9)


@given(places, st.floats(-3.1, 3.1))
def test_heading_is_minus_the_angle_from_corner_3_to_0(
    centre: tuple[float, float, float], angle_rad: float
) -> None:
    # At angle 0, the side points up in the image, along minus y: its angle is -90 degrees.
    expected = np.pi / 2 - angle_rad
    found = heading(seen(centre, angle_rad, 0.2))
    assert abs(np.angle(np.exp(1j * (found - expected)))) < 1e-6


def test_corners_that_fall_together() -> None:
    with pytest.raises(ValueError, match="are at one point"):
        camera_point(np.zeros((4, 2)), 0.2)


@given(places, st.floats(-3, 3), st.floats(0.05, 0.5))
def test_the_slopes_are_those_of_the_camera_point(
    centre: tuple[float, float, float], angle_rad: float, length_m: float
) -> None:
    uv = seen(centre, angle_rad, length_m)
    uv += np.random.default_rng(0).normal(0, 0.002, (4, 2))
    steps = 1e-7 * np.eye(8).reshape(8, 4, 2)
    by_step = [camera_point(uv + s, length_m) - camera_point(uv - s, length_m) for s in steps]
    expected = np.reshape(by_step, (4, 2, 3)).swapaxes(1, 2) / 2e-7
    np.testing.assert_allclose(camera_point_slopes(uv, length_m), expected, rtol=1e-4, atol=1e-3)


@given(st.integers(0, 1000), st.integers(1, 9))
def test_joint_and_single_fits_are_bit_identical(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    uv = rng.normal(0, 0.5, (count, 1, 2)) + rng.normal(0, 0.05, (count, 4, 2))
    lengths_m = rng.uniform(0.05, 0.3, count)
    together = camera_point(uv, lengths_m), camera_point_slopes(uv, lengths_m), heading(uv)
    for n, (corners, length_m) in enumerate(zip(uv, lengths_m.tolist(), strict=True)):
        alone = camera_point(corners, length_m), camera_point_slopes(corners, length_m), heading(corners)
        assert all(one.tobytes() == other[n].tobytes() for one, other in zip(alone, together, strict=True))
