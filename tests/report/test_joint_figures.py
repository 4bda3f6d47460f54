"""Figures of the cameras of a joint calibration: in files, and on the page."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from ipsys_log.app.report.calibration_figures import clocks_figure, poses_figure, residuals_figure
from ipsys_log.app.report.figures import png
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.html_figures import joint_pictures
from ipsys_log.messages import Floor, Rig
from ipsys_log.statistics.calibrated_cameras import CalibratedCamera, ImageResiduals
from tests import labs

CAMERAS = ("black", "red")


def calibrated(name: str, y_m: float, clock_sigma_s: float) -> CalibratedCamera:
    rng = np.random.default_rng(1)
    outline_m = np.array([[0.4, y_m - 1], [4.4, y_m - 1], [4.4, y_m + 1], [0.4, y_m + 1]])
    cells_px = np.stack(np.meshgrid(np.arange(60.0, 1920.0, 120), np.arange(60.0, 1080.0, 120)), axis=-1)
    cells_px = cells_px.reshape(-1, 2)
    means_px = rng.normal(0, 0.02, cells_px.shape)
    residuals = ImageResiduals(cells_px, means_px, np.abs(means_px[:, 0]), 0.02, 5000, 1)
    return CalibratedCamera(
        name,
        (1920, 1080),
        np.array([2.4, y_m, 2.1]),
        np.array([0.001, 0.001, 0.002]),
        np.array([0.05, 0.0, -1.0]),
        outline_m,
        0.004 if clock_sigma_s else 0.0,
        clock_sigma_s,
        residuals,
    )


@pytest.fixture(scope="module")
def cameras() -> tuple[CalibratedCamera, ...]:
    return calibrated("black", 1.4, 0.0), calibrated("red", 3.4, 0.0001)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return replace(labs.RIG, floor=Floor(4.8, 4.8)) if labs.RIG.floor is None else labs.RIG


def picture(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image)


def test_poses_show_each_camera_in_its_colour(cameras: tuple[CalibratedCamera, ...], rig: Rig) -> None:
    image = picture(png(poses_figure(cameras, rig))).astype(int)
    red = (np.abs(image - [0x00, 0x5E, 0xD5]).max(axis=2) < 40).sum(axis=1)
    # The field of view from above, and the rays in the view from the side.
    assert red[: len(red) // 2].sum() > 500
    assert red[int(0.6 * len(red)) :].sum() > 300


def test_residuals_and_clocks_are_drawn(cameras: tuple[CalibratedCamera, ...]) -> None:
    for figure in (residuals_figure(cameras[0], 0.05), clocks_figure(cameras)):
        image = picture(png(figure))
        assert (image.min(axis=2) < 128).mean() > 0.004


def test_page_has_a_picture_of_each_kind(cameras: tuple[CalibratedCamera, ...], rig: Rig) -> None:
    findings = Findings(rig, (), {}, CAMERAS, None, cameras)
    captions = [one["caption"] for one in joint_pictures(findings)]
    assert len(captions) == 4
    assert captions[0].startswith("Poses of the cameras")
    assert captions[1].startswith("Clock offsets")
    assert "image of black" in captions[2]
    assert captions[3].endswith(". Without one sighting that does not fit")
    assert all(one["width"] < 480 for one in joint_pictures(findings))
    contradicted = replace(findings, clock_contradictions=("camera red: its clock",))
    assert joint_pictures(contradicted)[1]["caption"].endswith(". Contradiction: camera red: its clock")
    still = tuple(replace(camera, clock_sigma_s=0.0, residuals=None) for camera in cameras)
    assert len(joint_pictures(replace(findings, calibrated=still))) == 1
    assert joint_pictures(replace(findings, calibrated=())) == []
