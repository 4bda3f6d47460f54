"""Cameras of a joint calibration, as the figures show them: poses, fields of view, clocks and residuals."""

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.statistics.calibrated_cameras import CalibratedCamera, describe_cameras
from ipsys_log.vision.lenses import project
from ipsys_log.vision.poses import invert_pose
from tests.joint.small_lab import Truth, make_lab

NOISE_PX = 0.02
SIZES_PX = {"c0": (1920, 1080), "c1": (1920, 1080)}


@pytest.fixture(scope="module")
def lab() -> tuple[Observations, Truth]:
    return make_lab(6, points=40, noise_px=NOISE_PX)


@pytest.fixture(scope="module")
def fit(lab: tuple[Observations, Truth]) -> JointFit:
    return fit_jointly(lab[0])


@pytest.fixture(scope="module")
def cameras(fit: JointFit) -> tuple[CalibratedCamera, ...]:
    return describe_cameras(joint_payload(fit, {}, 0), SIZES_PX, fit)


def test_poses_agree_with_the_truth_within_their_sigmas(
    lab: tuple[Observations, Truth], cameras: tuple[CalibratedCamera, ...]
) -> None:
    for camera, camera_from_world in zip(cameras, lab[1].camera_from_world, strict=True):
        world_from_camera = invert_pose(camera_from_world)
        assert (np.abs(camera.origin_m - world_from_camera[:3, 3]) < 4 * camera.sigmas_m).all()
        assert (camera.sigmas_m > 0).all()
        assert float(camera.axis @ world_from_camera[:3, 2]) > 0.9999
        assert (camera.clock_s, camera.clock_sigma_s) == (0, 0)


def test_outline_is_the_border_of_the_image(fit: JointFit, cameras: tuple[CalibratedCamera, ...]) -> None:
    for camera, model in zip(cameras, build_models(fit).values(), strict=True):
        floor_m = np.column_stack([camera.outline_m, np.zeros(len(camera.outline_m))])
        pixels = project((floor_m - model.origin_m) @ model.camera_from_world.T, model.calibration)
        beside_px = np.minimum(np.abs(pixels), np.abs(pixels - [1919, 1079])).min(axis=1)
        assert beside_px.max() < 0.01
        assert len(pixels) == 64


def test_residuals_are_those_of_the_noise(cameras: tuple[CalibratedCamera, ...]) -> None:
    for camera in cameras:
        residuals = camera.residuals
        assert residuals is not None
        # A marker that one camera sees has six unknowns and eight coordinates.
        assert 0.45 * NOISE_PX < residuals.total_rms_px < 1.05 * NOISE_PX
        assert residuals.outliers == 0
        assert (np.linalg.norm(residuals.means_px, axis=1) < 5 * residuals.total_rms_px).all()
        assert ((residuals.cells_px > 0) & (residuals.cells_px < [1920, 1080])).all()


def test_disturbed_marker_is_left_out_of_the_residuals(lab: tuple[Observations, Truth]) -> None:
    first, *rest = lab[0].sightings
    pixels = first.pixels.copy()
    pixels[0, 0] += 30.0
    spoiled = fit_jointly(replace(lab[0], sightings=(replace(first, pixels=pixels), *rest)))
    camera, _ = describe_cameras(joint_payload(spoiled, {}, 0), SIZES_PX, spoiled)
    assert camera.residuals is not None
    assert camera.residuals.outliers == 1
    assert camera.residuals.total_rms_px < 2 * NOISE_PX


def test_camera_without_sightings_has_a_pose(fit: JointFit) -> None:
    camera, _ = describe_cameras(joint_payload(fit, {}, 0), {}, None)
    assert camera.residuals is None
    assert len(camera.outline_m) == 0
    assert camera.origin_m[2] > 1.5
