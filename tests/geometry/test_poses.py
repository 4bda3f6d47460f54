import numpy as np
import pytest

from ipsys_log.vision.markers import heading, marker_corners
from ipsys_log.vision.poses import invert_pose, look_down, make_pose, pose_facing_up, rotation, transform


def test_a_pose_and_its_inverse_cancel() -> None:
    pose = make_pose(rotation(np.array([0.3, -0.5, 1.1])), np.array([1.0, -2.0, 0.5]))
    np.testing.assert_allclose(pose @ invert_pose(pose), np.eye(4), atol=1e-15)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    pose = make_pose(rotation(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    np.testing.assert_allclose(transform(pose, np.array([[1.0, 0.0, 0.0]])), [[0.0, 1.0, 0.0]], atol=1e-15)


def test_a_camera_that_looks_down_sees_the_floor_as_from_above() -> None:
    camera_from_world = look_down(np.array([1.0, 2.0, 2.1]))
    seen = transform(camera_from_world, np.array([[1.5, 2.0, 0.0], [1.0, 2.5, 0.0]]))
    np.testing.assert_allclose(seen, [[0.5, 0.0, 2.1], [0.0, -0.5, 2.1]], atol=1e-15)
    assert np.linalg.det(camera_from_world[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("angle_rad", [-3.0, -1.0, 0.0, 0.5, 2.5])
def test_the_heading_in_the_image_is_the_heading_in_the_world(angle_rad: float) -> None:
    camera_from_marker = look_down(np.array([2.0, 2.0, 2.1])) @ pose_facing_up(2.3, 1.8, 0.1, angle_rad)
    corners_m = transform(camera_from_marker, marker_corners(0.2))
    assert heading(corners_m[:, :2] / corners_m[:, 2:]) == pytest.approx(angle_rad)
