"""Outliers among the measurements of a joint fit, in the form of those of the other models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ipsys_log.analysis.outliers import describe_outlier
from ipsys_log.analysis.tape import RiggedMeasurement
from ipsys_log.joint.diagnosis import find_faults, point_covariances
from ipsys_log.joint.fit import JointFit
from ipsys_log.messages import Suspect

# Kinds of faults that concern the measurement of a point.
_OF_A_POINT = ("distance", "height", "place", "swapped", "side")
# Error of the place of a point that is not in the fit, by the shape of all points.
_SHAPE_SIGMA_M = 0.01


def find_joint_outliers(fit: JointFit, places: Sequence[RiggedMeasurement]) -> tuple[Suspect, ...]:
    """Return the measurements that contradict a joint fit, the one with the largest error first.

    The loss of the fit is robust: a wrong reading has nearly no weight in the estimated point. So this point
    is the prediction from all other observations, and no further fit is necessary.

    Parameters
    ----------
    fit : the fit to all measurements.
    places : the measurements, each with the rig in force.

    Raises
    ------
    IpsysError
        A measurement forms no world point.
    """
    by_id = {place.measurement.id: place for place in places}
    numbers = {point.name: number for number, point in enumerate(fit.observations.points)}
    floor_m = fit.problem.layout.floor.heights(
        fit.state.positions_m[:, :2], fit.state.values[fit.problem.layout.modes]
    )[0]
    usual_m2 = point_covariances(fit)
    outliers = []
    for fault in find_faults(fit):
        if fault.kind not in _OF_A_POINT or fault.subject not in by_id:
            continue
        number = numbers.get(fault.subject, -1)
        if fault.place_m is not None:
            predicted_m = np.array([*fault.place_m, by_id[fault.subject].measurement.height_m or 0.0])
            covariance_m2 = _SHAPE_SIGMA_M**2 * np.eye(3)
        else:
            predicted_m, covariance_m2 = fit.state.positions_m[number].copy(), usual_m2[number]
            # A measured height is that above the floor, and not that above the plane z = 0.
            predicted_m[2] -= floor_m[number]
        cameras = tuple(
            camera.name
            for camera, sightings in zip(fit.observations.cameras, fit.observations.sightings, strict=True)
            if number >= 0 and (sightings.point == number).any()
        )
        place = by_id[fault.subject]
        outliers.append(describe_outlier(place, cameras, predicted_m, covariance_m2, fault.score))
    return tuple(sorted(outliers, key=lambda suspect: -float((suspect.residual_m**2).sum())))
