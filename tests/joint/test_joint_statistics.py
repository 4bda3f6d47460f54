"""Many small labs: the stated covariance is that of the errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import pose_facing_up, transform
from tests.geometric.floor_error import region_shares
from tests.joint.small_lab import LENGTH_M, Array, Truth, make_lab

GRID = [(x, y, 0.1, 0.0) for x in np.arange(1.2, 3.7, 0.3) for y in np.arange(1.6, 3.3, 0.3)]


def locate_grid(models: dict[str, JointModel], truth: Truth) -> tuple[Array, Array]:
    """Return 2D errors (n, 2) and covariances (n, 2, 2) of exact corners, of all cameras."""
    errors, covariances = [], []
    corners_m = [transform(pose_facing_up(*pose), marker_corners(LENGTH_M)) for pose in GRID]
    exact = np.tile(1e-8 * np.eye(8), (len(GRID), 1, 1))
    rows = np.full(len(GRID), 0.1), np.full(len(GRID), LENGTH_M), 0.0, 0.0
    for model, lens, pose in zip(models.values(), truth.lenses, truth.camera_from_world, strict=True):
        pixels = np.stack([project(transform(pose, corners), lens) for corners in corners_m])
        found = locate_markers(model, pixels, exact, *rows)
        errors.append(found.points_m[:, :2] - np.array(GRID)[:, :2])
        covariances.append(found.covariances_m2[:, :2, :2])
    return np.concatenate(errors), np.concatenate(covariances)


def with_scales(observations: Observations, seed: int) -> Observations:
    """Draw the scales of the tape and of the reference points in the rig."""
    tape = observations.tape
    scale, size = 1 + np.random.default_rng(seed).normal(0, (tape.scale_sigma, tape.references_sigma))
    points = tuple(
        replace(
            point,
            distances_m=scale * point.distances_m,
            references_m=tape.middle_m + (point.references_m - tape.middle_m) / size,
        )
        for point in observations.points
    )
    return replace(observations, points=points)


@pytest.mark.slow
def test_covariance_is_that_of_the_errors_over_labs() -> None:
    shares = []
    for seed in range(60):
        observations, truth = make_lab(1000 + seed, points=16)
        fit = fit_jointly(with_scales(observations, seed))
        errors = locate_grid(build_models(fit), truth)
        shares.append(region_shares(*errors))
    # One lab gives one draw: its standard deviation is about 0.25.
    assert 0.60 < np.mean([one.inside_68 for one in shares]) < 0.80
    assert 0.90 < np.mean([one.inside_95 for one in shares]) < 0.99
    assert 0.70 < np.mean([one.nees for one in shares]) < 1.2
