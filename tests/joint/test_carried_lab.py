"""Cameras on walls from a carried body: poses, clocks and lenses with their uncertainties."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.carried_observations import gather_carried
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hand_held import fit_hand_held
from ipsys_log.calibration.joint.held_out import corner_sigma, hold_out_halves
from ipsys_log.calibration.joint.lab_frame import LabFrame
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.errors import FitError, IpsysError
from tests.joint.carried_wand import BODY, CLOCKS_S, ROW_S, CarriedWand, calibrate, carry_wand, pose_errors
from tests.joint.small_lab import Array

JITTER_S = 0.003


def in_sigmas(lab: JointFit, columns: list[int], truth: Array) -> Array:
    sigmas = np.sqrt(lab.covariance.diagonal()[columns])
    return np.asarray((lab.state.values[columns] - truth) / sigmas)


@pytest.fixture(scope="module")
def wand() -> CarriedWand:
    return carry_wand(11, count=3, jitter_s=JITTER_S)


@pytest.fixture(scope="module")
def lab(wand: CarriedWand) -> tuple[JointFit, LabFrame, JointFit]:
    return calibrate(wand)


def test_body_at_rest_defines_the_poses_of_cameras_on_walls(
    wand: CarriedWand, lab: tuple[JointFit, LabFrame, JointFit]
) -> None:
    errors, scores = pose_errors(lab[2], wand)
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.006
    assert np.degrees(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.15
    assert scores.max() < 2.0
    for name, model in build_models(lab[2]).items():
        assert model.origin_m == pytest.approx(
            -wand.camera_from_world[name][:3, :3].T @ wand.camera_from_world[name][:3, 3], abs=0.006
        )
        # Only the usual unevenness of the floor is known.
        floor = model.floor.modes(np.array([[1.0, 1.0]])) @ model.floor_modes
        assert np.sqrt((floor**2).sum()) == pytest.approx(0.001, rel=0.2)


def test_clocks_rows_and_lenses_agree_with_their_sigmas(
    wand: CarriedWand, lab: tuple[JointFit, LabFrame, JointFit]
) -> None:
    blocks = lab[2].problem.layout.cameras
    clocks = in_sigmas(lab[2], [block.edge + 1 for block in blocks[1:]], np.array(CLOCKS_S[1:3]))
    rows = in_sigmas(lab[2], [block.edge + 2 for block in blocks], np.full(3, ROW_S))
    lenses = []
    for block, (name, true) in zip(blocks, wand.true_lenses.items(), strict=False):
        assert name in wand.lenses
        K = np.r_[true.K[0, 0], true.K[1, 1], true.K[:2, 2]]
        lenses.append(in_sigmas(lab[2], [*range(block.lens.start, block.lens.start + 4)], K))
    for scores in (clocks, rows, np.concatenate(lenses)):
        assert np.abs(scores).max() < 4
        assert np.sqrt(np.mean(scores**2)) < 2


def test_jitter_noise_and_held_out_frames_are_as_simulated(lab: tuple[JointFit, LabFrame, JointFit]) -> None:
    fit = lab[0]
    assert fit.settings.stamp_jitter_s == pytest.approx(JITTER_S, rel=0.5)
    assert corner_sigma(fit) == pytest.approx(0.05, rel=0.1)
    errors_px = np.concatenate(hold_out_halves(fit))
    lengths_px = np.linalg.norm(errors_px, axis=2)
    # A jitter of 3 ms at 1 m/s and 4 m from the camera is 0.8 px.
    assert 0.1 < float(np.sqrt(np.mean(lengths_px**2))) < 1.5


def test_measured_points_define_the_coordinates_and_a_wrong_one_is_named() -> None:
    wand = carry_wand(3, count=3, duration_s=12.0, taped=True)
    _, frame, lab = calibrate(wand)
    errors, scores = pose_errors(lab, wand)
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.008
    assert scores.max() < 2.5
    assert frame.worst[1] < 4
    third = wand.measurements[2]
    long = tuple(replace(one, distance_m=one.distance_m + 0.05) for one in third.distances)
    wrong = replace(wand, measurements=[*wand.measurements])
    wrong.measurements[2] = replace(third, distances=long)
    worst = calibrate(wrong)[1].worst
    assert worst[0] == "p2"
    assert worst[1] > 8


def test_motion_that_is_too_short_is_refused(wand: CarriedWand) -> None:
    short = {camera: own[:3] for camera, own in wand.markers.items()}
    observations, _, _ = gather_carried(wand.rig, wand.lenses, (), short, BODY, [])
    with pytest.raises(FitError, match="the body moves in too few frames; carry it for 20 s"):
        fit_hand_held(observations)


def test_unknown_bodies_and_bodies_that_are_not_seen_are_refused(wand: CarriedWand) -> None:
    for rig, markers, text in (
        (replace(wand.rig, bodies=()), wand.markers, f"{BODY}: is no body of the rig, which has none"),
        (wand.rig, {"c0": [replace(one, markers=()) for one in wand.markers["c0"]]}, "no frame shows its"),
    ):
        with pytest.raises(IpsysError, match=text):
            gather_carried(rig, wand.lenses, (), markers, BODY, [])
