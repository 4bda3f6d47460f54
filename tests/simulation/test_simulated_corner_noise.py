"""The noise of simulated corners: its covariance, its structure, and its size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.geometry.markers import marker_corners
from ipsys_log.geometry.poses import pose_facing_up
from ipsys_log.simulation.cameras import Camera, mount_cameras
from ipsys_log.simulation.settings import LabSettings
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


def test_average_over_frames_leaves_the_repeatable_part(camera: Camera) -> None:
    stated, placements, frames = covariances(camera, POSES[:1]), 1500, 12
    rows, numbers = placements * frames, np.repeat(np.arange(placements), frames)
    noise_px = draw_corner_noise(np.repeat(stated, rows, axis=0), numbers, np.random.default_rng(1))
    means = noise_px.reshape(placements, frames, 8).mean(axis=1)
    wanted = (REPEATABLE_SHARE + WHITE_SHARE / frames) * np.trace(stated[0])
    assert (means**2).sum(axis=1).mean() == pytest.approx(wanted, rel=0.05)


def test_covariance_allows_only_motions_of_a_rigid_square(camera: Camera) -> None:
    for stated, pose in zip(covariances(camera, POSES), POSES, strict=True):
        seen = camera.camera_from_world @ pose_facing_up(*pose)
        turn, _ = cv2.Rodrigues(seen[:3, :3])
        _, slopes = cv2.fisheye.projectPoints(
            marker_corners(0.2)[None], turn, seen[:3, 3].copy(), camera.lens.K, camera.lens.D
        )
        # OpenCV's columns: fx fy, cx cy, k1..k4, rotation, translation, skew.
        motions = np.linalg.qr(slopes[:, 8:14])[0]
        variances, axes = np.linalg.eigh(stated)
        assert (variances[:2] < 1e-6 * variances[7]).all()
        assert (variances[2:] > 1e-3 * variances[7]).all()
        likely = axes[:, 2:]
        assert np.abs(likely - motions @ (motions.T @ likely)).max() < 1e-4


def test_covariance_has_the_size_that_detect_states(camera: Camera) -> None:
    # A rendered lab with 20 cm markers gave 0.011 px, and 0.014 px for the smallest markers.
    rms_px = np.sqrt(np.trace(covariances(camera, POSES), axis1=1, axis2=2) / 8)
    assert ((rms_px > 0.010) & (rms_px < 0.015)).all()


@pytest.mark.parametrize(
    "worse",
    [
        LabSettings(noise_sigma=6.0),
        LabSettings(black=80.0, white=130.0),
        LabSettings(psf_sigma_px=1.3),
    ],
)
def test_noise_low_contrast_and_blur_increase_the_error(worse: LabSettings) -> None:
    assert 1.5 < edge_sigma_px(worse) / edge_sigma_px(LAB) < 4.0
