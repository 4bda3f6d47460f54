"""Result of a joint calibration of a lab: expected errors, coverage, residuals, outliers, and what to add."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.calibration.joint.diagnosis import find_faults
from ipsys_log.calibration.joint.fit import Finding, JointFit
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.engine.graph import writes
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CameraCalibration, Rig
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, MODEL, Channel
from ipsys_log.messages.stage import Progress
from ipsys_log.statistics import expected_error
from ipsys_log.statistics.calibration_points import measured, split_ids
from ipsys_log.statistics.floor_cameras import FloorGrid
from ipsys_log.statistics.joint_evaluation import fit_without, is_nominal, observe
from ipsys_log.statistics.marker_tests import find_contradicted_inputs
from ipsys_log.statistics.tape import expected_tape_covariances

# Without a floor in the rig, the map reaches this far beyond the places of the markers.
_AROUND_M = 0.5
# Distance between possible points, in m; larger on a large floor.
_STEP_M, _SPAN_M = 0.4, 10.0
_MOST_POINTS = 4
# A gap is worth a drive if its mean expected error exceeds the goal, and this multiple of the camera's mean.
_WORSE = 1.1
# The scale of the tape is worth a reading if it gives this share of the expected error.
_LARGE_SHARE = 0.4
# Kinds of faults after which the covariance of the fit is not true. The robust loss removes the others.
_CAUSES = ("doubt", "camera", "row_time", "length", "robot_height", "tape")
# So are wrong readings of more than this share of the points: another fault may explain them all.
_READINGS, _FEW_WRONG = ("distance", "height", "place", "swapped"), 0.1


@dataclass(frozen=True, slots=True, eq=False)
class CameraResult:
    """The calibration of one camera.

    Attributes
    ----------
    expected : expected errors over the floor.
    sightings : number of sightings in the fit: at calibration points, and of moving robots.
    rmse_px : root mean square of the reprojection errors per coordinate, without outliers.
    covered : share of the seen floor where the camera saw a marker; ``gaps`` are the other parts.
    places_m : (k, 2), positions of the markers that it saw.
    clock_s : the clock offset of the stored model, in s: 0 if it is not significant; None without drives.
    nominal : the intrinsics were nominal.
    row_time_s : the estimated time between two rows, in s; None if the rig has it.
    """

    expected: expected_error.ExpectedErrors
    sightings: tuple[int, int]
    rmse_px: float
    covered: float
    gaps: tuple[expected_error.FloorGap, ...]
    places_m: Array
    clock_s: float | None
    nominal: bool
    row_time_s: float | None = None

    @property
    def camera(self) -> str:
        """The name of the camera."""
        return self.expected.camera

    @property
    def mean_m(self) -> float:
        """The mean expected error over the floor; NaN if the camera sees no node."""
        errors_m = self.expected.errors_m
        return float(errors_m.mean()) if len(errors_m) else float("nan")

    @property
    def p95_m(self) -> float:
        """The 95th percentile of the expected errors over the floor."""
        errors_m = self.expected.errors_m
        return float(np.percentile(errors_m, 95)) if len(errors_m) else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class LabCalibration:
    """The joint calibration of a lab, and its quality.

    Attributes
    ----------
    run, rig : run of the model, and the rig in force.
    goal_m : wanted mean error of every camera.
    cameras : by name, in alphabetical order.
    grid : nodes of the map.
    height_m : height of the robots' markers, for which the errors hold.
    points_m : (p, 2), the calibration points.
    points : points to tape next, with their effect; empty if the goal is reached.
    gap : the part of the floor that a robot should cross; None if none is needed.
    faults : probable faults of the observations, without single sightings of moving markers.
    ignored : number of sightings of moving markers that do not fit; they have little weight.
    missing : cameras of the log without a model, because they saw no marker of the fit.
    notes : remarks.
    contradictions : what the markers contradict, of the intrinsics and the rig.
    tape_advice : how to find the scale of the tape, where this helps most; else empty.
    """

    run: str
    rig: Rig
    goal_m: float
    cameras: tuple[CameraResult, ...]
    grid: FloorGrid
    height_m: float
    points_m: Array
    points: tuple[expected_error.TapedPoint, ...]
    gap: expected_error.FloorGap | None
    faults: tuple[Finding, ...]
    ignored: int
    missing: tuple[str, ...]
    notes: tuple[str, ...]
    contradictions: tuple[str, ...] = ()
    tape_advice: str = ""

    @property
    def mean_m(self) -> float:
        """The mean expected error over all cameras and nodes."""
        return float(self._errors_m().mean())

    @property
    def p95_m(self) -> float:
        """The 95th percentile over all cameras and nodes."""
        return float(np.percentile(self._errors_m(), 95))

    @property
    def worst(self) -> CameraResult:
        """The camera with the largest mean expected error."""
        return max(
            (camera for camera in self.cameras if len(camera.expected.errors_m)),
            key=lambda camera: camera.mean_m,
        )

    @property
    def causes(self) -> tuple[str, ...]:
        """The faults that make all figures untrue: wrong intrinsics, sizes and readings, moved cameras."""
        wrong = {fault.subject for fault in self.faults if fault.kind in _READINGS}
        kinds = _CAUSES + (_READINGS if len(wrong) > _FEW_WRONG * len(self.points_m) else ())
        return (*self.contradictions, *(fault.text for fault in self.faults if fault.kind in kinds))

    @property
    def is_enough(self) -> bool:
        """True if every camera of the log has a model, with a mean expected error of at most the goal."""
        return self.worst.mean_m <= self.goal_m and not self.missing and not self.causes

    def _errors_m(self) -> Array:
        return np.concatenate([camera.expected.errors_m for camera in self.cameras])


def describe_lab(
    session: Session,
    run: str,
    rig: Rig,
    lenses: Mapping[str, CameraCalibration],
    given: tuple[Rig | None, Mapping[str, CameraCalibration]],
    train: str,
    goal_m: float,
    progress: Progress = lambda done, total: None,
) -> LabCalibration:
    """Describe the joint calibration of a run.

    Parameters
    ----------
    session : open logs.
    run : run of the fitted model.
    rig, lenses : rig and intrinsics in force; ``lenses`` by camera.
    given : the rig and the intrinsics that replaced those of the log.
    train : label of the measurements of the fit.
    goal_m : wanted mean error of every camera.
    progress : called with the steps of the fit.
    """
    view = LogView(session, _inputs(session, run), *given)
    points = [point.measurement for point in measured(view)]
    used, _ = split_ids(points, {"train": train})
    observations = observe(view)
    fit = fit_without(observations, {point.id for point in points} - used, progress)
    names = [camera.name for camera in observations.cameras]
    frames = ((str(message.camera), message.payload) for message in view.messages(MARKERS))
    contradictions = [*find_contradicted_inputs(frames, lenses, rig)]
    return describe_fit(fit, names, run, rig, lenses, goal_m, contradictions)


def describe_fit(
    fit: JointFit,
    names: Sequence[str],
    run: str,
    rig: Rig,
    lenses: Mapping[str, CameraCalibration],
    goal_m: float,
    contradictions: Sequence[str],
) -> LabCalibration:
    """Describe a joint fit; ``names`` are all cameras with markers, see :func:`describe_lab`."""
    models = build_models(fit)
    sizes_px = {camera: (lenses[camera].width, lenses[camera].height) for camera in models}
    places_m = _places(fit, models)
    low_m, high_m = _corners(rig, places_m)
    step_m = 0.1 * max(1, round(float((high_m - low_m).max()) / _SPAN_M))
    grid = FloorGrid.over(low_m, high_m, step_m)
    height_m, length_m = _usual_marker(rig, fit)
    expected = expected_error.expect_errors(models, sizes_px, grid, height_m, length_m)
    if not any(len(one.errors_m) for one in expected):
        raise IpsysError(
            f"no camera sees a whole marker {height_m:g} m above the floor; correct the floor and the "
            "marker_height_m in lab.toml"
        )
    cameras = tuple(
        _describe_camera(
            fit,
            number,
            one,
            grid,
            places_m[number],
            models[one.camera].clock_s,
            nominal=is_nominal(lenses[one.camera]),
        )
        for number, one in enumerate(expected)
    )
    gap = _choose_gap(cameras, goal_m)
    taped = expected_error.choose_points(
        expected,
        _candidates(rig, low_m, high_m, step_m),
        # Another reading has the same scale: it tells nothing of the part of the error by the scale.
        expected_tape_covariances(rig, scale_sigma=fit.observations.tape.scale_sigma),
        goal_m if max(c.mean_m for c in cameras if len(c.expected.errors_m)) > goal_m else np.inf,
        _MOST_POINTS if len(rig.reference_points) > 1 else 0,
    )
    points_m = fit.state.positions_m[:, :2]
    missing = tuple(sorted(set(names) - models.keys()))
    findings = find_faults(fit)
    faults = tuple(finding for finding in findings if not finding.moving)
    ignored = len(findings) - len(faults)
    notes = tuple(_notes(rig, cameras, missing, len(points_m), ignored))
    return LabCalibration(
        run,
        rig,
        goal_m,
        cameras,
        grid,
        height_m,
        points_m,
        tuple(taped),
        gap,
        faults,
        ignored,
        missing,
        notes,
        tuple(contradictions),
        _tape_advice(rig, fit, float(np.nanmean([camera.mean_m for camera in cameras]))),
    )


def _tape_advice(rig: Rig, fit: JointFit, mean_m: float) -> str:
    """Return the next step if the scale of the tape is a large part of the expected error."""
    columns, middle_m = fit.problem.layout.tape, fit.observations.tape.middle_m
    scale_sigma = float(np.sqrt(fit.covariance[columns.start, columns.start]))
    away_m = float(np.linalg.norm(fit.state.positions_m[:, :2] - middle_m, axis=1).mean())
    if len(rig.reference_points) < 2 or scale_sigma * away_m < _LARGE_SHARE * mean_m:
        return ""
    first, second = (point.name for point in rig.reference_points[:2])
    if rig.ab_sigma_m is None:
        return (
            f"The scale of the tape is known to {scale_sigma:.2%}: if another instrument measured {first} "
            f"and {second}, give ab_sigma_m in lab.toml; else compare the tape, and give tape_scale_sigma"
        )
    if not len(fit.observations.tape.readings_m):
        return f"Read the distance from {first} to {second} with the tape: ipsys measure LOG --ab CM."
    return ""


def _inputs(session: Session, run: str) -> dict[Channel, str]:
    """Return the runs of markers and camera points that a fit read."""
    record = next(
        record for record in reversed(session.runs()) if record.run == run and writes(record, MODEL)
    )
    return {
        channel: source
        for channel in (MARKERS, CAMERA_POINTS)
        for source in record.input_runs
        if session.topics(channel, source)
    }


def _places(fit: JointFit, models: Mapping[str, JointModel]) -> list[Array]:
    """Return the positions (k, 2) of the markers that each camera saw."""
    places = []
    bodies, points = fit.observations.bodies, fit.observations.points
    for camera, sightings in zip(fit.observations.cameras, fit.observations.sightings, strict=True):
        if camera.is_former:
            continue
        heights_m = [
            (points[point].height_m if point >= 0 else bodies[body].height_m) or 0.0
            for body, point in zip(sightings.body.tolist(), sightings.point.tolist(), strict=True)
        ]
        lengths_m = np.array([bodies[body].length_m for body in sightings.body.tolist()])
        located = locate_markers(
            models[camera.name].without_modes(),
            sightings.pixels,
            sightings.covariances_px2,
            np.array(heights_m),
            lengths_m,
        )
        places_m = located.points_m[:, :2]
        places.append(places_m[np.isfinite(places_m).all(axis=1)])
    return places


def _corners(rig: Rig, places_m: Sequence[Array]) -> tuple[Array, Array]:
    if rig.floor is not None:
        return np.zeros(2), np.array([rig.floor.width_m, rig.floor.depth_m])
    everything_m = np.concatenate(places_m)
    low_m, high_m = np.percentile(everything_m, [1, 99], axis=0)
    return np.round(low_m - _AROUND_M, 1), np.round(high_m + _AROUND_M, 1)


def _usual_marker(rig: Rig, fit: JointFit) -> tuple[float, float]:
    """Return the height and the side of the robots' markers."""
    # A marker for calibration points lies on the floor: no robot carries it.
    carried_m = [height for marker in rig.markers if (height := rig.height_of(marker.id))]
    measured_m = [point.height_m for point in fit.observations.points if point.height_m is not None]
    height_m = rig.marker_height_m
    if height_m is None:
        height_m = float(np.median(carried_m or measured_m or [0.0]))
    return round(height_m, 3), max(body.length_m for body in fit.observations.bodies)


def _describe_camera(
    fit: JointFit,
    number: int,
    expected: expected_error.ExpectedErrors,
    grid: FloorGrid,
    places_m: Array,
    clock_s: float,
    nominal: bool,
) -> CameraResult:
    sightings = fit.observations.sightings[number]
    moving = int((sightings.point < 0).sum())
    covered, gaps = expected_error.find_floor_gaps(expected, grid, places_m)
    counts = len(sightings) - moving, moving
    return CameraResult(
        expected,
        counts,
        _rmse_px(fit, number),
        covered,
        tuple(gaps),
        places_m,
        clock_s if moving else None,
        nominal,
        _row_time_s(fit, number) if moving else None,
    )


def _row_time_s(fit: JointFit, camera: int) -> float | None:
    """Return the row time of a camera if the fit estimates it."""
    column = fit.problem.layout.cameras[camera].edge + 2
    if not fit.problem.layout.free[column]:
        return None
    return fit.observations.cameras[camera].known_row_s + float(fit.state.values[column])


def _rmse_px(fit: JointFit, camera: int) -> float:
    """Return the root mean square of the reprojection errors of a camera, without outliers."""
    squares = []
    for factors in fit.problem.sightings:
        if factors.camera != camera:
            continue
        whitened = factors.residuals(fit.state, fit.problem.layout, fit.problem.trajectories)
        residuals_px = np.linalg.solve(factors.whitening, whitened[:, :, None])[:, :, 0]
        good = (whitened**2).sum(axis=1) <= factors.limit
        squares.append((residuals_px[good] ** 2).ravel())
    values = np.concatenate(squares) if squares else np.zeros(0)
    return float(np.sqrt(values.mean())) if len(values) else float("nan")


def _choose_gap(cameras: Sequence[CameraResult], goal_m: float) -> expected_error.FloorGap | None:
    """Return the gap that costs most: area times expected error."""
    worth = [
        gap for camera in cameras for gap in camera.gaps if gap.error_m > max(goal_m, _WORSE * camera.mean_m)
    ]
    return max(worth, key=lambda gap: gap.area_m2 * gap.error_m, default=None)


def _candidates(rig: Rig, low_m: Array, high_m: Array, step_m: float) -> Array:
    """Return possible points for a taped marker, (c, 2), in whole decimetres."""
    step_m = max(_STEP_M, 4 * step_m)
    inside_m = [
        np.arange(a + 0.3, b - 0.3 + 1e-6, step_m).round(2) for a, b in zip(low_m, high_m, strict=True)
    ]
    points_m = np.stack(np.meshgrid(*inside_m), axis=-1).reshape(-1, 2)
    known_m = np.array([(p.x_m, p.y_m) for p in rig.reference_points]).reshape(-1, 2)
    apart_m = np.linalg.norm(points_m[:, None] - known_m, axis=2)
    free: Array = points_m[(apart_m > _STEP_M).all(axis=1)]
    return free


def _notes(
    rig: Rig, cameras: Sequence[CameraResult], missing: Sequence[str], points: int, ignored: int
) -> Iterator[str]:
    for name in missing:
        yield f"camera {name} saw no marker of the fit: it has no model; drive through its field of view"
    seen = {*missing, *(camera.camera for camera in cameras)}
    for name in sorted({camera.name for camera in rig.cameras} - seen):
        yield f"camera {name} of the rig is not in the log: it has no model"
    nominal = [camera.camera for camera in cameras if camera.nominal]
    if nominal:
        yield (
            f"nominal intrinsics of camera {', '.join(nominal)}: the fit estimates focal length and lens "
            "distortion, too"
        )
    if not any(camera.sightings[1] for camera in cameras):
        yield (
            "no sightings of moving robots: set marker_height_m in lab.toml, and drive a robot through all "
            "fields of view"
        )
    if ignored:
        moving = sum(camera.sightings[1] for camera in cameras)
        yield (
            f"{ignored} of {moving} sightings of moving markers do not fit, and have little weight; if they "
            "are many, drive without sharp turns, and check the ids and the heights of the markers"
        )
    if rig.floor is None:
        yield "the rig has no floor: the map covers the places of the markers and 50 cm around them"
    if points < 4:
        yield (f"{points} calibration points: with fewer than 4, the fit cannot find a wrong reading")
