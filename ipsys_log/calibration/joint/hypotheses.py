"""The joint fit under the hypothesis that explains most with least: wrong sides, moved cameras, row times.

A plain fit believes its inputs. If its readings or its sightings contradict it, hypotheses about the inputs
are compared before anything is called an outlier.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.calibration.joint.diagnosis import point_covariances, standardise_readings
from ipsys_log.calibration.joint.fit import Finding, JointFit, fit_jointly, fit_shape
from ipsys_log.calibration.joint.moved_cameras import (
    CameraMotion,
    explains_squares,
    find_motion,
    row_time_evidence,
    sum_squares,
)
from ipsys_log.calibration.joint.observations import (
    CalibrationPoint,
    Observations,
    divide_camera,
    without_cameras,
    without_points,
)
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.start import (
    PlacedCamera,
    UnplacedError,
    place_cameras,
    place_freely,
    rough_points,
)
from ipsys_log.calibration.joint.tape_explanations import (
    WRONG_NUMBER,
    Explanation,
    PointShape,
    explain_readings,
    side_contradicts,
)
from ipsys_log.errors import FitError
from ipsys_log.units import CM_PER_M

Progress = Callable[[int, float], None]
# The decrease of the sum of squares by a motion of a camera, or by free row times (None).
_Cause = tuple[float, CameraMotion | None]

# A reading contradicts the fit above this many standard deviations.
_WRONG = 4.5
# A rough place of a point that is farther than this from its tape readings shows a wrong start: a length, and
# a share of the reach of the readings.
_ROUGH_M = 0.1
_ROUGH_SHARE = 0.03
# With more sightings that do not fit, the fit is not to be believed.
_MOST_OUTLIERS = 0.2
# A hypothesis about cameras must decrease twice the cost by this much: once in a million sessions by chance.
_LEAST_GAIN = 60.0
_MOST_HYPOTHESES = 3
# The number of hypotheses that are tried: each is a fit.
_MOST_TRIALS = 2
# If the first one leaves a smaller share of outliers,
_FEW_OUTLIERS = 0.01
# the second one is tried only if it has at least this share of the evidence.
_MUCH_LESS = 0.5
# Row times have fewer unknowns than a motion at any time: they come first if they explain this share of it.
_ROWS_SHARE = 0.25
# Two hypotheses are both possible if their probabilities differ by less than a factor of 100.
_AS_PROBABLE = 2 * float(np.log(100.0))
# The first time of a motion is rough; the poses before and after it give a better one.
_MOST_TIMES = 3
_US_PER_S = 1e6
# Mistakes whose points are not used. A wrong distance has little weight by the robust loss.
_LEFT_OUT = ("side", "exchanged", "side and exchanged", "swapped")


def fit_hypotheses(
    observations: Observations,
    settings: JointSettings | None = None,
    progress: Progress = lambda step, cost: None,
) -> JointFit:
    """Fit a lab, and correct inputs that contradict the rest; the fit names them in ``known``.

    Cameras that nothing connects with the others are left out: more sightings never prevent a fit.

    Raises
    ------
    FitError
        The observations do not determine the cameras.
    """
    settings = settings or JointSettings()
    try:
        return _fit_inputs(observations, settings, progress)
    except UnplacedError as error:
        rest = without_cameras(observations, error.cameras)
        if not rest.cameras:
            raise
        fit = fit_hypotheses(rest, settings, progress)
        left_out = [observations.cameras[camera].name for camera in error.cameras]
        known = [Finding("left_out", name, 0.0, f"{error}; it is left out") for name in left_out[:1]]
        return replace(fit, known=(*known, *fit.known))


def _fit_inputs(observations: Observations, settings: JointSettings, progress: Progress) -> JointFit:
    """Return the fit to the inputs that agree; it names the others.

    Cameras come first: a moved one spoils the shape of the points, which explains the readings.
    """
    explained, error = None, None
    try:
        placed = place_cameras(observations)
        if _agrees_roughly(observations, placed):
            fit = fit_jointly(observations, settings, progress, placed)
            explained = _explain_cameras(fit, settings, progress)
            if not _is_contradicted(fit) or not _is_contradicted(explained):
                return explained
    except UnplacedError:
        raise
    except FitError as caught:
        error = caught
    explanations = _explain_tape(observations, settings, progress)
    if explanations and not explanations[0].changes:
        # The readings as they are need no other explanation.
        explanations = explanations[:1]
    if explanations and (explained is None or len(explanations) > 1 or _left_out(explanations[0])):
        fit = _fit_explained(observations, explanations, settings, progress)
        return _explain_cameras(fit, settings, progress)
    if explained is not None:
        return explained
    if error is not None:
        raise error
    return _explain_cameras(fit_jointly(observations, settings, progress), settings, progress)


def _agrees_roughly(observations: Observations, placed: Sequence[PlacedCamera]) -> bool:
    """Return whether all points are about where their readings place them."""
    places_m = rough_points(observations, list(placed))[0][:, :2]
    seen = np.zeros(len(observations.points), dtype=np.bool_)
    for sightings in observations.sightings:
        seen[sightings.point[sightings.point >= 0]] = True
    for point, place_m, is_seen in zip(observations.points, places_m, seen.tolist(), strict=True):
        if not is_seen or point.start_m is None:
            continue
        reach_m = float(max(point.distances_m, default=0.0))
        if np.linalg.norm(place_m - point.start_m) > _ROUGH_M + _ROUGH_SHARE * reach_m:
            return False
    return True


def _is_contradicted(fit: JointFit) -> bool:
    """Return whether readings or many sightings do not fit."""
    if any(one.score > _WRONG and one.kind != "height" for one in standardise_readings(fit)):
        return True
    places_m, covariances_m2 = fit.state.positions_m[:, :2], point_covariances(fit)[:, :2, :2]
    rows = zip(fit.observations.points, places_m, covariances_m2, strict=True)
    return any(side_contradicts(*row) for row in rows) or _outlier_share(fit) > _MOST_OUTLIERS


def _outlier_share(fit: JointFit) -> float:
    shares = fit.problem.shares_of_limit(fit.state)
    return float((shares > 1).mean()) if len(shares) else 0.0


def _explain_tape(
    observations: Observations, settings: JointSettings, progress: Progress
) -> list[Explanation]:
    """Return the explanations of the tape by the shape of the points; none if the cameras give no shape."""
    try:
        placed = place_freely(observations)
        fit = fit_shape(observations, settings, placed, progress)
    except (FitError, np.linalg.LinAlgError):
        return []
    numbers = {point.name: number for number, point in enumerate(observations.points)}
    points = [observations.points[numbers[point.name]] for point in fit.observations.points]
    return explain_readings(points, _shape(fit))


def _shape(fit: JointFit) -> PointShape:
    count = len(fit.observations.points)
    slopes, own = fit.solution.factorisation.local_from_global(0, 6 * count)
    rows = (6 * np.arange(count)[:, None] + np.arange(2)).ravel()
    covariance = own[np.ix_(rows, rows)] + slopes[rows] @ fit.covariance @ slopes[rows].T
    return PointShape(fit.state.positions_m[:, :2], covariance)


def _left_out(explanation: Explanation) -> set[str]:
    return {change.point for change in explanation.changes if change.kind in _LEFT_OUT}


def _fit_explained(
    observations: Observations,
    explanations: Sequence[Explanation],
    settings: JointSettings,
    progress: Progress,
) -> JointFit:
    """Return the fit without the points of wrong sides, or with all of them if too few remain."""
    best = explanations[0]
    places = dict(zip(best.names, best.places_m, strict=True))
    left_out = _left_out(best)
    kept = [point for point in observations.points if point.name in places and point.name not in left_out]
    is_alone = sum(len(point.distances_m) > 1 or point.point_m is not None for point in kept) < 2
    rest = observations if is_alone else without_points(observations, left_out)
    started = replace(
        rest,
        points=tuple(
            replace(point, start_m=places.get(point.name, point.start_m)) if len(point.distances_m) else point
            for point in rest.points
        ),
    )
    fit = fit_jointly(started, settings, progress)
    known = _name_changes(best, observations, is_alone)
    if len(explanations) > 1:
        known = [_name_doubt(explanations)]
    return replace(fit, known=tuple(known), is_certain=len(explanations) == 1)


_MISTAKES = {
    "side": "it fits on the other side of AB; correct its side",
    "exchanged": "it fits with its distances exchanged; correct them",
    "side and exchanged": "it fits on the other side of AB with its distances exchanged; correct both",
    "swapped": "its tape readings fit the place of point {other}; were they swapped? Correct them",
    "distance": "its distances do not fit; measure it again",
    "place": "it does not fit at its place; measure it again",
}


def _name_changes(explanation: Explanation, observations: Observations, is_alone: bool) -> list[Finding]:
    places = dict(zip(explanation.names, explanation.places_m.tolist(), strict=True))
    points = {point.name: point for point in observations.points}
    use = "the result corrects it" if is_alone else "the result is without this point"
    return [
        Finding(
            "side" if "side" in change.kind or change.kind == "exchanged" else change.kind,
            change.point,
            _score(points[change.point], places[change.point]),
            f"point {change.point}: {_MISTAKES[change.kind].format(other=change.other)}; {use}",
            place_m=tuple(places[change.point]),
        )
        for change in explanation.changes
        if change.kind in _LEFT_OUT
    ]


def _score(point: CalibrationPoint, place_m: Sequence[float]) -> float:
    """Return how far a point is from its readings, in standard deviations of a distance."""
    if point.start_m is None:
        return _WRONG
    return float(np.linalg.norm(point.start_m - place_m) / point.distance_sigmas_m.max())


def _name_doubt(explanations: Sequence[Explanation]) -> Finding:
    options = [
        " and ".join(
            f"{change.point}: {_MISTAKES[change.kind].format(other=change.other).split(';')[0].split('?')[0]}"
            for change in one.changes
        )
        or "all readings are right"
        for one in explanations
    ]
    names = sorted({change.point for one in explanations for change in one.changes})
    text = (
        f"the readings of {', '.join(names)} have more than one explanation ({'; or '.join(options)}): no "
        "position is certain; check these readings, or measure another point"
    )
    return Finding("doubt", names[0], 0.0, text)


def _explain_cameras(fit: JointFit, settings: JointSettings, progress: Progress) -> JointFit:
    """Return the fit with the moved cameras and wrong row times that explain most, one after the other."""
    for _ in range(_MOST_HYPOTHESES):
        causes = _likely_causes(fit)
        trial = _try_causes(fit, causes[:_MOST_TRIALS], settings, progress)
        if trial is None:
            break
        if _gain(fit, trial) < _LEAST_GAIN:
            return _doubt_readings(fit, trial)
        most = max(chi2 for chi2, _ in causes)
        possible = [motion for chi2, motion in causes if most - chi2 < _AS_PROBABLE]
        if len(possible) > 1:
            return replace(trial, known=(*fit.known, _name_rivals(fit, possible)), is_certain=False)
        fit = replace(trial, is_certain=fit.is_certain)
    return fit


def _likely_causes(fit: JointFit) -> list[_Cause]:
    """Return motions of cameras and wrong row times (None), with what they explain, the likely ones first."""
    squares = sum_squares(fit)
    causes: list[_Cause] = [
        (motion.chi2, motion)
        for number, camera in enumerate(fit.observations.cameras)
        if not camera.is_former and (motion := find_motion(squares, number)) is not None
    ]
    causes.sort(key=lambda cause: -cause[0])
    if by_rows := row_time_evidence(squares):
        is_first = not causes or by_rows > _ROWS_SHARE * causes[0][0]
        causes.insert(0 if is_first else len(causes), (by_rows, None))
    return causes


def _try_causes(
    fit: JointFit, causes: Sequence[_Cause], settings: JointSettings, progress: Progress
) -> JointFit | None:
    """Return the fit of least cost, without trials of causes that explain much less than one that fits."""
    trials, most = [], 0.0
    for chi2, motion in causes:
        if chi2 < _MUCH_LESS * most:
            break
        if motion is None:
            trial = _try_row_times(fit, settings, progress)
        else:
            trial = _try_motion(fit, motion, settings, progress)
        if trial is not None and _gain(fit, trial) > _LEAST_GAIN - _AS_PROBABLE:
            trials.append(trial)
            if _outlier_share(trial) < _FEW_OUTLIERS:
                most = np.inf if motion is None else chi2
    return min(trials, key=lambda one: one.solution.cost, default=None)


def _doubt_readings(fit: JointFit, trial: JointFit) -> JointFit:
    """Return a fit without certainty if a cause explains it nearly as well as wrong readings do."""
    wrong = sorted({one.point for one in standardise_readings(fit) if one.score > _WRONG})
    if not wrong:
        return fit
    cause = trial.known[-1]
    text = (
        f"{cause.text.split(';')[0]}; or readings of {', '.join(wrong)} are wrong: no position is certain; "
        "measure these points again, and one more"
    )
    return replace(fit, known=(*fit.known, replace(cause, kind="doubt", text=text)), is_certain=False)


def _name_rivals(fit: JointFit, possible: Sequence[CameraMotion | None]) -> Finding:
    names = [fit.observations.cameras[one.camera].name for one in possible if one is not None]
    options = [f"camera {name} was moved" for name in names]
    if None in possible:
        options.append("the row times in the rig are wrong")
    text = f"{' or '.join(options)}: no position is certain; calibrate again, with more observations"
    return Finding("doubt", names[0], 0.0, text)


def _gain(fit: JointFit, trial: JointFit | None) -> float:
    """Return by how much twice the cost of a fit is more than that of a trial.

    A reading costs no more than a wrong number, and an outlier no more than its limit: a motion of a camera
    explains no mistyped height, and no single sighting.
    """
    if trial is None:
        return 0.0
    before, after = (
        2 * one.solution.cost - one.problem.excess_loss(one.state, WRONG_NUMBER) for one in (fit, trial)
    )
    return before - after


def _try_row_times(fit: JointFit, settings: JointSettings, progress: Progress) -> JointFit | None:
    """Return the fit with free row times of all cameras; None if it shows no wrong one."""
    cameras = tuple(replace(camera, row_time_s=None) for camera in fit.observations.cameras)
    trial = _refit(replace(fit.observations, cameras=cameras), settings, progress)
    if trial is None:
        return None
    found = []
    for camera, block in zip(cameras, trial.problem.layout.cameras, strict=True):
        row_s, sigma_s = (
            trial.state.values[block.edge + 2],
            trial.covariance[block.edge + 2, block.edge + 2] ** 0.5,
        )
        if abs(row_s) > _WRONG * sigma_s and not camera.is_former:
            total_us, rig_us = _US_PER_S * (camera.known_row_s + row_s), _US_PER_S * camera.known_row_s
            found.append((camera.name, f"{total_us:.1f} us, not {rig_us:.1f} us", abs(row_s) / sigma_s))
    if not found:
        return None
    names = ", ".join(name for name, _, _ in found)
    times = "; ".join(text for _, text, _ in found)
    text = (
        f"camera {names}: by the drives, the time between two rows is {times}; correct row_time_ns in the rig"
    )
    finding = Finding("row_time", found[0][0], max(score for _, _, score in found), text)
    return replace(trial, known=(*fit.known, finding))


def _try_motion(
    fit: JointFit, motion: CameraMotion, settings: JointSettings, progress: Progress
) -> JointFit | None:
    """Return the fit in which a camera has another pose before a motion."""
    camera, former = motion.camera, len(fit.observations.cameras)
    trial: JointFit | None = None
    later = motion
    for _ in range(_MOST_TIMES):
        divided = _refit(divide_camera(fit.observations, camera, later.time_s), settings, progress)
        if divided is None or _gain(fit, divided) <= _gain(fit, trial):
            break
        trial, time_s, squares = divided, later.time_s, sum_squares(divided)
        # A further motion of either part means that sightings are on the wrong side of the time.
        found = [one for n in (camera, former) if (one := find_motion(squares, n)) is not None]
        if not found:
            break
        later = max(found, key=lambda one: one.chi2)
    if trial is None or not explains_squares(fit, trial, motion):
        return None
    # The two poses of the trial have their own intrinsics, which may take a part of the turn.
    name = fit.observations.cameras[camera].name
    text = (
        f"camera {name}: it was moved after about {time_s:.0f} s, by {motion.shift_m * CM_PER_M:.1f} cm "
        f"and {np.degrees(motion.turn_rad):.2f} degrees; "
        "the result has its later pose; calibrate again with the observations before or after"
    )
    finding = Finding("camera", name, float(np.sqrt(motion.chi2)), text)
    return replace(trial, known=(*fit.known, finding))


def _refit(observations: Observations, settings: JointSettings, progress: Progress) -> JointFit | None:
    """Return the fit of changed observations; None if they determine nothing, or only after minutes."""
    try:
        fit = fit_jointly(observations, replace(settings, follows_valleys=False), progress)
        return replace(fit, settings=settings)
    except FitError:
        return None
