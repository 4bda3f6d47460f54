"""The test of camera intrinsics by the markers in the images, against markers through other intrinsics."""

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.messages import CameraCalibration, RigMarker
from tests.analysis.marked_floor import (
    FISHEYE,
    PINHOLE,
    RIG,
    calibrated_with_errors,
    changed,
    contradictions,
    sighted,
)


@pytest.mark.parametrize("lens", [FISHEYE, PINHOLE], ids=["fisheye", "pinhole"])
@pytest.mark.parametrize("noise_px", [0.03, 0.3], ids=["edges", "stock"])
def test_honest_calibrations_are_not_contradicted(lens: CameraCalibration, noise_px: float) -> None:
    for seed in range(6):
        random = np.random.default_rng(100 + seed)
        assert not contradictions(
            sighted(lens, random, noise_px=noise_px), calibrated_with_errors(lens, random)
        )


def test_markers_in_a_hand_contradict_no_calibration() -> None:
    for seed in range(4):
        random = np.random.default_rng(seed)
        frames = sighted(FISHEYE, random, wild_deg=20, camera_deg=30)
        assert not contradictions(frames, calibrated_with_errors(FISHEYE, random))


@pytest.mark.parametrize(
    "wrong",
    [
        changed(FISHEYE, f=1.1),
        changed(FISHEYE, f=0.8),
        changed(FISHEYE, fy=1.05),
        changed(FISHEYE, cx=-481, cy=-270),
        replace(changed(FISHEYE, cx=-481, cy=-270), K=FISHEYE.K * [[0.5], [0.5], [1]]),
        replace(FISHEYE, distortion_model="plumb_bob", D=np.append(FISHEYE.D, 0.0)),
        replace(FISHEYE, D=np.array([-0.28, 0.09, 0.0005, -0.0003])),
    ],
    ids=["zoom", "wider", "aspect", "half centre", "half size", "as pinhole", "coefficients"],
)
def test_wrong_calibration_is_contradicted_once(wrong: CameraCalibration) -> None:
    (text,) = contradictions(sighted(FISHEYE, np.random.default_rng(1)), wrong)
    assert text.startswith("camera red: markers do not fit its calibration (")
    assert text.endswith(" px expected); is it the file of this camera, size and lens model?")


def test_pinhole_coefficients_as_fisheye_are_contradicted() -> None:
    wrong = replace(PINHOLE, distortion_model="kannala_brandt", D=PINHOLE.D[:4])
    assert len(contradictions(sighted(PINHOLE, np.random.default_rng(1)), wrong)) == 1


def test_wrong_length_of_a_marker_names_the_marker() -> None:
    frames = sighted(FISHEYE, np.random.default_rng(1), lengths_m=(0.2, 0.18, 0.2))
    (text,) = contradictions(frames, FISHEYE)
    assert text.startswith("camera red: marker 1 looks 1")
    assert "too small beside the others; measure its side" in text


def test_wrong_length_of_one_of_two_names_both() -> None:
    frames = sighted(FISHEYE, np.random.default_rng(1), lengths_m=(0.2, 0.18))
    (text,) = contradictions(frames, FISHEYE, replace(RIG, markers=RIG.markers[:2]))
    assert "the sizes of markers 0 and 1 contradict each other by 1" in text


def test_lengths_in_the_rig_are_not_contradicted() -> None:
    frames = sighted(FISHEYE, np.random.default_rng(1), lengths_m=(0.2, 0.18, 0.2))
    markers = (RIG.markers[0], RigMarker(1, length_m=0.18, height_m=0.1), RIG.markers[2])
    assert not contradictions(frames, FISHEYE, replace(RIG, markers=markers))
