"""The scale of the tape as an unknown of the joint fit: its covariance and its contradictions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.calibration.joint.diagnosis import find_faults, point_covariances
from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.observations import Observations, Tape
from ipsys_log.messages import Distance, Measurement, ReferencePoint, Rig
from tests.joint.small_lab import make_lab

Array = NDArray[np.float64]

SEEDS = range(8)
POINTS = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 4.0, 0.0))
RIG = Rig("lab", "DICT_4X4_100", 0.2, reference_points=POINTS)
BASELINE = Measurement(0, "ab", distances=(Distance("B", 4.008),), from_reference="A")


def scaled(observations: Observations, scale: float, tape: Tape | None = None) -> Observations:
    """Return observations whose tape reads too long by a factor."""
    points = tuple(replace(p, distances_m=p.distances_m * scale) for p in observations.points)
    references_m = np.unique(np.concatenate([p.references_m for p in points]), axis=0)
    known = replace(tape or Tape(), middle_m=references_m.mean(axis=0))
    return replace(observations, points=points, tape=known)


@cache
def fit_lab(seed: int, scale: float) -> tuple[JointFit, Array]:
    """Return the fit of a lab, and the true positions (c, 3) of its cameras."""
    observations, truth = make_lab(seed=seed)
    origins_m: Array = np.linalg.inv(np.array(truth.camera_from_world))[:, :3, 3]
    return fit_jointly(scaled(observations, scale)), origins_m


def camera_nees(fit: JointFit, origins_m: Array) -> float:
    """Return the mean normalised squared error of the horizontal positions of the cameras."""
    values = []
    for block, true_m in zip(fit.problem.layout.cameras, origins_m, strict=True):
        place = slice(block.start + 3, block.start + 5)
        error_m = fit.state.values[place] - true_m[:2]
        values.append(error_m @ np.linalg.solve(fit.covariance[place, place], error_m) / 2)
    return float(np.mean(values))


def test_tape_of_0_3_percent_is_covered_by_covariance() -> None:
    nees = [camera_nees(*fit_lab(seed, 1.003)) for seed in SEEDS]
    assert np.mean(nees) < 2.5


def test_tape_of_2_percent_is_named() -> None:
    faults = find_faults(fit_lab(0, 1.02)[0])
    assert faults[0].kind == "tape"
    assert "too long for the reference points" in faults[0].text


@pytest.mark.parametrize("scale", [0.999, 1.0, 1.001])
def test_honest_tape_is_not_named(scale: float) -> None:
    assert not [fault for seed in SEEDS[:3] for fault in find_faults(fit_lab(seed, scale)[0])]


def test_covariance_grows_away_from_reference_points() -> None:
    observations, _ = make_lab(seed=1)
    known = fit_jointly(scaled(observations, 1.0, Tape(1e-6, 1e-6)))
    unknown, _ = fit_lab(1, 1.0)
    middle_m = unknown.observations.tape.middle_m
    flat = point_covariances(unknown)[:, :2, :2] - point_covariances(known)[:, :2, :2]
    grown_m2 = np.trace(flat, axis1=1, axis2=2)
    away_m = np.linalg.norm(known.state.positions_m[:, :2] - middle_m, axis=1)
    assert np.corrcoef(np.sqrt(np.maximum(grown_m2, 0)), away_m)[0, 1] > 0.8


def test_baseline_counts_only_with_ab_sigma() -> None:
    unknown = gather_observations(RIG, {}, {}, [], baselines=[BASELINE]).tape
    assert not len(unknown.readings_m)
    assert unknown.references_sigma == unknown.scale_sigma == 0.001
    known = gather_observations(replace(RIG, ab_sigma_m=0.002), {}, {}, [], baselines=[BASELINE]).tape
    assert known.readings_m.tolist() == [4.008]
    assert known.baselines_m.tolist() == [4.0]
    assert known.references_sigma == 0.0005


def test_scale_of_rig_replaces_usual_scale() -> None:
    assert gather_observations(replace(RIG, tape_scale_sigma=0.0002), {}, {}, []).tape.scale_sigma == 0.0002


def test_baseline_reduces_uncertainty_of_scale() -> None:
    observations, _ = make_lab(seed=2)
    read = Tape(0.001, 1e-5, np.zeros(2), np.array([4.0]), np.array([4.012]), np.array([0.0005]))
    fit = fit_jointly(scaled(observations, 1.003, read))
    tape = fit.problem.layout.tape.start
    assert abs(fit.state.values[tape] - 1.003) < 0.0006
    assert np.sqrt(fit.covariance[tape, tape]) < 0.0003
