"""Faults in the observations of a joint fit: wrong readings, wrong markers, moved cameras."""

from dataclasses import dataclass

import numpy as np

from ipsys_log.calibration.joint.fit import Finding, JointFit
from ipsys_log.calibration.joint.prior_sigmas import tape_contradiction
from ipsys_log.calibration.joint.robust import limit_of, robust_loss
from ipsys_log.calibration.joint.trajectories import Kind
from ipsys_log.messages import Array
from ipsys_log.units import CM_PER_M

# A reading is wrong if its error exceeds this many standard deviations.
_WRONG = 4.5
# The same for the scale of the tape. A lab has one, so a smaller limit rarely gives a false alarm.
_WRONG_TAPE = 3.5
# Nothing tests a reading if the others determine its value with less than this share of its information.
_LEAST_KEPT = 0.01
# A tape reading that fits the place of another point this well was swapped with it.
_SAME_PLACE_M = 0.03


@dataclass(frozen=True, slots=True)
class Reading:
    """A reading of tape or ruler, compared with the fit to all other observations.

    ``kind`` is ``distance``, ``height`` or ``place``; ``detail`` numbers the distances of a point.
    ``residual_m`` is estimated minus measured. ``score`` is its size in standard deviations.
    """

    point: str
    kind: str
    detail: int
    residual_m: float
    score: float


def standardise_readings(fit: JointFit) -> list[Reading]:
    """Return all readings with the residuals that they have if they are left out of the fit.

    References
    ----------
    Leave-one-out residuals of weighted least squares: Huber and Ronchetti, Robust Statistics, 2009, sect. 7.
    """
    names = [point.name for point in fit.observations.points]
    if not names:
        return []
    factors = fit.problem.points
    residuals = factors.residuals(fit.state, fit.problem.layout)
    spread = _spread_of_points(fit)
    readings = []
    seen: dict[int, int] = {}
    by_position_m, by_tape_m = factors.distance_slopes(fit.state, fit.problem.layout)
    for row, number in enumerate(factors.distance_points.tolist()):
        sigma_m = float(factors.distance_sigmas_m[row])
        variance = spread.along(number, np.r_[by_position_m[row], 0.0], by_tape_m[row])
        scored = _left_out(float(residuals.distances[row]) * sigma_m, sigma_m, variance)
        detail = seen[number] = seen.get(number, -1) + 1
        readings.append(Reading(names[number], "distance", detail, *scored))
    for row, number in enumerate(factors.height_points.tolist()):
        sigma_m = float(factors.height_sigmas_m[row])
        scored = _left_out(float(residuals.heights[row]) * sigma_m, sigma_m, spread.above_floor(number))
        readings.append(Reading(names[number], "height", 0, *scored))
    for row, number in enumerate(factors.place_points.tolist()):
        size = float(fit.state.values[fit.problem.layout.tape][1])
        given_m = factors.places_m[row] + (size - 1) * factors.place_arms_m[row]
        offset_m = fit.state.positions_m[number, :2] - given_m
        away_m = max(float(np.hypot(*offset_m)), 1e-12)
        direction = np.r_[offset_m / away_m, 0.0]
        sigma_m = 1 / float(np.linalg.norm(factors.place_whitening[row] @ direction[:2]))
        by_size_m = np.array([0.0, -direction[:2] @ factors.place_arms_m[row]])
        scored = _left_out(away_m, sigma_m, spread.along(number, direction, by_size_m))
        readings.append(Reading(names[number], "place", 0, *scored))
    return readings


def _left_out(residual_m: float, sigma_m: float, variance: float) -> tuple[float, float]:
    """Return the residual of a reading that is left out of the fit, and its score.

    Both are 0 if nothing but the reading determines the value.
    """
    limit = float(limit_of(1.0))
    weight = float(robust_loss(np.array([(residual_m / sigma_m) ** 2]), limit)[1][0])
    kept = 1 - weight * variance / sigma_m**2
    if kept < _LEAST_KEPT:
        return 0.0, 0.0
    alone_m = residual_m / kept
    return alone_m, abs(alone_m) / float(np.sqrt(sigma_m**2 + variance / kept))


@dataclass(frozen=True, slots=True, eq=False)
class _PointSpread:
    """Uncertainty of the estimated calibration points.

    ``own`` (t, 3, 3) is that for constant global unknowns, ``by_global`` (t, 3, g) the slopes by these,
    ``floor`` (t, g) the slopes of the floor's height. ``tape`` are the columns of the tape.
    """

    own: Array
    by_global: Array
    floor: Array
    covariance: Array
    tape: slice

    def along(self, number: int, direction: Array, by_tape: Array) -> float:
        """Return the variance of a point along a direction (3,), with slopes (2,) by the tape's scales."""
        slope = direction @ self.by_global[number]
        slope[self.tape] += by_tape
        return float(direction @ self.own[number] @ direction + slope @ self.covariance @ slope)

    def above_floor(self, number: int) -> float:
        """Return the variance of the height of a point above the floor."""
        slope = self.by_global[number, 2] - self.floor[number]
        return float(self.own[number, 2, 2] + slope @ self.covariance @ slope)


def _spread_of_points(fit: JointFit) -> _PointSpread:
    count, layout = len(fit.observations.points), fit.problem.layout
    slopes, own = fit.solution.factorisation.local_from_global(0, 6 * count)
    rows = (6 * np.arange(count)[:, None] + np.arange(3)).ravel()
    number = np.arange(count)
    floor = np.zeros((count, len(layout.mean)))
    floor[:, layout.modes] = layout.floor.modes(fit.state.positions_m)
    return _PointSpread(
        own.reshape(count, 6, count, 6)[number, :3, number, :3],
        slopes[rows].reshape(count, 3, -1),
        floor,
        fit.covariance,
        layout.tape,
    )


def point_covariances(fit: JointFit) -> Array:
    """Return the covariances (t, 3, 3) of the estimated calibration points in the world, in m^2."""
    spread = _spread_of_points(fit)
    return np.asarray(spread.own + spread.by_global @ fit.covariance @ spread.by_global.swapaxes(1, 2))


def find_faults(fit: JointFit) -> list[Finding]:
    """Return probable faults: causes of other faults first, then by their scores."""
    findings = [
        *_wrong_tape(fit),
        *fit.known,
        *_wrong_readings(fit),
        *_wrong_bodies(fit),
        *_wrong_sightings(fit),
    ]
    first = ("doubt", "camera", "row_time", "length", "robot_height", "tape")
    return sorted(findings, key=lambda one: (one.kind not in first, -one.score, one.kind, one.subject))


def _wrong_tape(fit: JointFit) -> list[Finding]:
    longer, score = tape_contradiction(fit.problem.layout, fit.state, fit.covariance, fit.observations)
    if abs(score) <= _WRONG_TAPE:
        return []
    text = (
        f"tape: its readings are {abs(longer):.2%} too {'long' if longer > 0 else 'short'} for the reference "
        "points of the rig; measure their distance with another instrument, and correct the rig or the tape"
    )
    return [Finding("tape", "tape", abs(score), text)]


def _wrong_readings(fit: JointFit) -> list[Finding]:
    wrong: dict[str, list[Reading]] = {}
    for reading in standardise_readings(fit):
        if reading.score > _WRONG:
            wrong.setdefault(reading.point, []).append(reading)
    findings = []
    for name, readings in wrong.items():
        worst = max(readings, key=lambda reading: reading.score)
        twin = _twin(fit, name) if worst.kind != "height" else None
        if twin is not None:
            text = f"point {name}: its tape readings fit the place of point {twin}; were they swapped?"
            findings.append(Finding("swapped", name, worst.score, text))
            continue
        tape = [reading for reading in readings if reading.kind == "distance"]
        if len(tape) > 1:
            largest_cm = max(abs(reading.residual_m) for reading in tape) * CM_PER_M
            text = (
                f"point {name}: its distances disagree with the cameras by up to {largest_cm:.1f} cm; check "
                "the side, the id of the marker, and if the marker was moved"
            )
            findings.append(Finding("distance", name, worst.score, text))
            continue
        text = ", ".join(
            f"{_reading_name(reading)} is {abs(reading.residual_m) * CM_PER_M:.1f} cm too "
            f"{'short' if reading.residual_m > 0 else 'long'}"
            for reading in readings
        )
        findings.append(Finding(worst.kind, name, worst.score, f"point {name}: {text}; measure it again"))
    return findings


def _reading_name(reading: Reading) -> str:
    if reading.kind == "distance":
        return f"distance {reading.detail + 1}"
    return "the height" if reading.kind == "height" else "the distance to the given place"


def _twin(fit: JointFit, name: str) -> str | None:
    """Return another point at the place that the tape gives for a point."""
    points = fit.observations.points
    number = next(n for n, point in enumerate(points) if point.name == name)
    start_m = points[number].start_m
    if start_m is None:
        return None
    apart_m = np.linalg.norm(fit.state.positions_m[:, :2] - start_m, axis=1)
    nearest = int(apart_m.argmin())
    return points[nearest].name if nearest != number and apart_m[nearest] < _SAME_PLACE_M else None


def _wrong_bodies(fit: JointFit) -> list[Finding]:
    layout, bodies = fit.problem.layout, fit.observations.bodies
    residuals = fit.problem.prior_residuals(fit.state)
    scales, heights = fit.state.values[layout.scales], fit.state.values[layout.heights]
    findings = []
    for number, body in enumerate(bodies):
        score = abs(float(residuals[layout.scales][number]))
        if score > _WRONG:
            side_cm = body.length_m * CM_PER_M
            text = (
                f"marker {body.name}: its side is {side_cm * scales[number]:.2f} cm, not {side_cm:.2f} cm; "
                "measure the print, and correct the rig"
            )
            findings.append(Finding("length", body.name, score, text))
        score = abs(float(residuals[layout.heights][number]))
        if score > _WRONG and body.height_m is not None:
            text = (
                f"marker {body.name}: a robot carries it at {heights[number] * CM_PER_M:.1f} cm, not at "
                f"{body.height_m * CM_PER_M:.1f} cm; correct the rig, or exchange the markers of two robots"
            )
            findings.append(Finding("robot_height", body.name, score, text))
    return findings


def _wrong_sightings(fit: JointFit) -> list[Finding]:
    findings = []
    problem, observations = fit.problem, fit.observations
    for factors in problem.sightings:
        chi2 = factors.chi2(fit.state, problem.layout, problem.trajectories)
        camera = observations.cameras[factors.camera].name
        for row in np.flatnonzero(chi2 > 2 * factors.limit).tolist():
            score = float(np.sqrt(chi2[row]))
            body = observations.bodies[int(factors.sightings.body[row])].name
            where = (
                f"at {factors.sightings.times_s[row]:.2f} s"
                if factors.kind is not Kind.STATIONARY
                else f"at point {observations.points[int(factors.trajectory[row])].name}"
            )
            text = (
                f"camera {camera}: marker {body} {where} is not where the other observations place it; it "
                "may be another marker, or the camera or the marker was moved"
            )
            findings.append(Finding("sighting", camera, score, text, factors.kind is not Kind.STATIONARY))
    return findings
