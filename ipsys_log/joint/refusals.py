"""Observations that cannot determine a lab: they are refused, with a sentence that says what to do."""

from __future__ import annotations

import numpy as np

from ipsys_log.errors import FitError
from ipsys_log.joint.observations import Observations
from ipsys_log.joint.solver import ConvergenceError


def check_observations(observations: Observations) -> None:
    """Check that there are sightings, a length, and two measured points.

    Raises
    ------
    FitError
        Something of it is missing.
    """
    for camera, sightings in zip(observations.cameras, observations.sightings, strict=True):
        if not len(sightings):
            raise FitError(
                f"camera {camera.name}: it saw no marker at a measured point or on a robot; leave it out"
            )
    measured = [point for point in observations.points if len(point.distances_m) or point.point_m is not None]
    has_tape = any(len(point.distances_m) for point in measured) or len(measured) > 1
    if not has_tape and all(np.isinf(body.scale_sigma) for body in observations.bodies):
        raise FitError("no length is known; give the side of the markers, or measure distances with a tape")
    if len(measured) < 2:
        raise FitError(
            f"{len(measured)} measured points; measure at least two with the tape, some metres apart: "
            "they define the coordinates of the floor"
        )


def explain(error: ConvergenceError, observations: Observations) -> FitError:
    """Return the error of a fit that did not converge, with the cameras that nothing holds.

    A camera whose sightings all count as outliers can move without limit.
    """
    problem, state = error.problem, error.state
    counts = {camera: [0, 0] for camera in range(len(observations.cameras))}
    for factors in problem.sightings:
        chi2 = (factors.residuals(state, problem.layout, problem.trajectories) ** 2).sum(axis=1)
        counts[factors.camera][0] += len(chi2)
        counts[factors.camera][1] += int((chi2 <= factors.limit).sum())
    lost = [
        f"{observations.cameras[camera].name} ({seen} sightings)"
        for camera, (seen, fitting) in counts.items()
        if not fitting
    ]
    if not lost:
        return error
    return FitError(
        f"the joint fit did not converge: no sighting of camera {', '.join(lost)} fits to the other "
        "cameras; drive a robot through its field of view, or leave the camera out"
    )
