"""The noise of simulated corners: its covariance, its structure, and its size."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import Camera, mount_cameras
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.vision.poses import pose_facing_up
from tests.geometric.corner_noise import (
    REPEATABLE_SHARE,
    WHITE_SHARE,
    corner_covariances,
    draw_corner_noise,
    edge_sigma_px,
)

Array = NDArray[np.float64]

LAB = LabSettings()
POSES = np.array([[2.4, 0.9, 0.1, 0.3], [0.6, 1.2, 0.0, -2.0], [4.1, 0.4, 0.2, 1.1]])


@pytest.fixture(scope="module")
def camera() -> Camera:
    return mount_cameras(LAB)[0]


def covariances(camera: Camera, poses: Array) -> Array:
    seen = np.array([camera.camera_from_world @ pose_facing_up(*pose) for pose in poses])
    return corner_covariances(camera.lens, seen[:, :3, :3], seen[:, :3, 3], 0.2, edge_sigma_px(LAB))


def test_noise_has_the_stated_covariance(camera: Camera) -> None:
    stated, draws = covariances(camera, POSES[1:2]), 20_000
    noise_px = draw_corner_noise(
        np.repeat(stated, draws, axis=0), np.arange(draws), np.random.default_rng(0)
    ).reshape(-1, 8)
    sample = noise_px.T @ noise_px / draws
    variances = np.diag(stated[0])
    scale = np.sqrt(np.outer(variances, variances))
    wanted = (WHITE_SHARE + REPEATABLE_SHARE) * stated[0]
    assert np.abs((sample - wanted) / scale).max() < 5 * 1.15 * np.sqrt(2 / draws)


def test_covariance_has_the_size_that_detect_states(camera: Camera) -> None:
    # A rendered lab with 20 cm markers gave 0.011 px, and 0.014 px for the smallest markers.
    rms_px = np.sqrt(np.trace(covariances(camera, POSES), axis1=1, axis2=2) / 8)
    assert ((rms_px > 0.010) & (rms_px < 0.015)).all()
