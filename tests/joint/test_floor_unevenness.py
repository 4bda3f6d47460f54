"""The standard deviation of the floor is estimated, so that stated covariances hold on any floor."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.capture.simulation.settings import LabSettings
from tests.geometric.lab import GeometricSettings, build_lab
from tests.joint.test_drives import observe

LAB = GeometricSettings(lab=LabSettings(seed=6, rate_hz=10.0, drive_s=0.0), points=60)


@pytest.mark.parametrize(("rms_m", "low_m", "high_m"), [(0.0, 0.0, 0.0005), (0.003, 0.002, 0.0045)])
def test_sigma_of_the_floor_is_estimated(rms_m: float, low_m: float, high_m: float) -> None:
    lab = build_lab(replace(LAB, floor_rms_m=rms_m))
    field = fit_jointly(observe(lab)).problem.layout.floor
    inside = field.origin_m + 2.0
    sigma_m = float((field.modes(inside[None]) ** 2).sum() ** 0.5)
    assert low_m <= sigma_m < high_m
