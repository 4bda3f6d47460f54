"""The joint calibration of a lab: from observations to cameras, floor and their covariance."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.calibration.joint.floor_field import FloorField, make_floor_field
from ipsys_log.calibration.joint.observations import Observations, without_points
from ipsys_log.calibration.joint.parameters import Layout, State, make_layout
from ipsys_log.calibration.joint.path_start import start_paths
from ipsys_log.calibration.joint.point_factors import make_point_factors
from ipsys_log.calibration.joint.prior_sigmas import most_likely_scale, widen_tape
from ipsys_log.calibration.joint.problem import Problem, find_blocks
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.sighting_factors import (
    SightingFactors,
    at_one_instant,
    make_sighting_factors,
)
from ipsys_log.calibration.joint.solver import (
    COLD_DAMPING,
    SHORT,
    WARM_DAMPING,
    ConvergenceError,
    Solution,
    solve,
)
from ipsys_log.calibration.joint.start import PlacedCamera, UnplacedError, place_cameras, rough_points
from ipsys_log.calibration.joint.trajectories import Kind, Trajectories
from ipsys_log.errors import FitError
from ipsys_log.messages import Array, Indices
from ipsys_log.vision.poses import level_turns

# The field of the floor reaches this far beyond the outermost place of a marker.
_BEYOND_M = 1.0
# The largest area of the field, in squares of its correlation length: 62 m^2 at the usual length.
_MOST_LENGTHS = 250
# Before the wobble of robots is known from their poses, a step need not be so exact.
_ROUGH = 0.3
# The same before the unevenness of the floor is known.
_NEAR = 0.03


@dataclass(frozen=True, slots=True)
class Finding:
    """A probable fault.

    ``kind`` is ``distance``, ``height``, ``place``, ``swapped``, ``side``, ``doubt``, ``length``,
    ``robot_height``, ``sighting``, ``tape``, ``row_time``, ``left_out`` or ``camera``; ``subject`` is the
    point, marker, tape or camera. ``score`` is in standard deviations. ``moving`` is True for a sighting of a
    moving marker.
    ``place_m`` is the true place of a point that is not in the fit.
    """

    kind: str
    subject: str
    score: float
    text: str
    moving: bool = False
    place_m: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """The result of a joint calibration.

    ``covariance`` (g, g) is that of the global unknowns, in the order of ``problem.layout``. ``known`` are
    faults whose observations are not in the fit, or have their own unknowns. ``is_certain`` is False
    if another explanation of the readings is as probable: then the covariance does not contain the errors.
    """

    observations: Observations
    settings: JointSettings
    problem: Problem
    solution: Solution
    covariance: Array
    known: tuple[Finding, ...] = ()
    is_certain: bool = True

    @property
    def state(self) -> State:
        """The estimated values of all unknowns."""
        return self.solution.state


def fit_jointly(
    observations: Observations,
    settings: JointSettings | None = None,
    progress: Callable[[int, float], None] = lambda step, cost: None,
    placed: list[PlacedCamera] | None = None,
) -> JointFit:
    """Estimate all cameras of a lab, the floor and the places of the markers together.

    Parameters
    ----------
    observations : cameras, markers, calibration points, and sightings.
    settings : prior standard deviations; None: the defaults.
    progress : called with the number of steps and the cost after each step.
    placed : rough poses of the cameras; None: those of :func:`place_cameras`.

    Raises
    ------
    FitError
        The observations do not determine the cameras.
    """
    check_observations(observations)
    observations = without_unseen(observations)
    try:
        placed = place_cameras(observations) if placed is None else placed
        return _fit(observations, settings or JointSettings(), placed, progress)
    except ConvergenceError as error:
        raise explain_divergence(error, observations) from error


def fit_shape(
    observations: Observations,
    settings: JointSettings,
    placed: list[PlacedCamera],
    progress: Callable[[int, float], None] = lambda step, cost: None,
) -> JointFit:
    """Estimate all cameras to each other, without the tape: one camera keeps its place and its heading.

    Parameters
    ----------
    observations, settings, progress : as for :func:`fit_jointly`; readings of the tape have no effect.
    placed : rough poses of the cameras to each other.

    Raises
    ------
    FitError
        The method does not converge, or the observations do not determine the cameras.
    """
    points = tuple(
        replace(
            point,
            references_m=np.zeros((0, 2)),
            distances_m=np.zeros(0),
            distance_sigmas_m=np.zeros(0),
            point_m=None,
            covariance_m2=None,
        )
        for point in observations.points
    )
    untaped = without_unseen(replace(observations, points=points))
    # One estimate of the floor is enough for a shape.
    settings = replace(settings, floor_sigma_spread=0.0)
    held = max(range(len(placed)), key=lambda camera: len(observations.sightings[camera]))
    return _fit(untaped, settings, placed, progress, held)


def refit_without(
    fit: JointFit, left_out: Collection[str], progress: Callable[[int, float], None] = lambda step, cost: None
) -> JointFit:
    """Estimate a lab without some of the calibration points of a fit, in a few steps from this fit.

    The unevenness of the floor, the wobble of the robots and the standard deviation of the tape's scale stay
    those of the fit.

    Raises
    ------
    FitError
        The other observations do not determine the cameras.
    """
    observations = without_points(fit.observations, left_out)
    check_observations(observations)
    kept = [n for n, point in enumerate(fit.observations.points) if point.name not in left_out]
    stationary = [sightings.point for sightings in observations.sightings]
    factors = _make_factors(observations, fit.settings, Kind.STATIONARY, stationary)
    factors += [one for one in fit.problem.sightings if one.kind is not Kind.STATIONARY]
    layout, trajectories = fit.problem.layout, replace(fit.problem.trajectories, stationary=len(kept))
    problem = Problem(
        layout,
        trajectories,
        tuple(sorted(factors, key=lambda one: one.camera)),
        make_point_factors(observations.points, observations.tape, fit.settings.point_tilt_sigma_rad),
        find_blocks(layout, trajectories, factors) if observations.in_hall else (),
    )
    state = replace(fit.state, positions_m=fit.state.positions_m[kept], turns=fit.state.turns[kept])
    try:
        return _solve(observations, fit.settings, problem, state, progress, _NEAR, WARM_DAMPING)
    except ConvergenceError as error:
        raise explain_divergence(error, observations) from error


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


def explain_divergence(error: ConvergenceError, observations: Observations) -> FitError:
    """Return the error of a fit that did not converge, with the cameras that nothing holds.

    A camera whose sightings all count as outliers can move without limit.
    """
    problem, state = error.problem, error.state
    counts = {camera: [0, 0] for camera in range(len(observations.cameras))}
    for factors in problem.sightings:
        chi2 = factors.chi2(state, problem.layout, problem.trajectories)
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


def _hold(layout: Layout, held: int, camera_from_world: Array) -> Layout:
    """Return a layout in which the place of a camera over the floor, and its heading, are constant."""
    start, sigma = layout.cameras[held].start, layout.sigma.copy()
    # A small turn about this axis of the camera changes its heading most.
    sigma[start + int(np.abs(camera_from_world[:, 2]).argmax())] = 0.0
    sigma[start + 3 : start + 5] = 0.0
    return replace(layout, sigma=sigma)


def _fit(
    observations: Observations,
    settings: JointSettings,
    placed: list[PlacedCamera],
    progress: Callable[[int, float], None],
    held: int | None = None,
) -> JointFit:
    problem, state = _build(observations, settings, placed)
    if held is not None:
        problem = replace(problem, layout=_hold(problem.layout, held, placed[held].camera_from_world))
    if len(problem.trajectories.paths):
        # The wobble of a robot acts on its corners by the poses, so that these come first.
        tilts = settings.wobble_sigma_rad, settings.wobble_time_s
        problem = problem.reweighted(state, *tilts)
        state = solve(problem, state, progress, _ROUGH, observations.in_hall, settings.follows_valleys).state
        problem = problem.reweighted(state, *tilts)
    if not problem.layout.floor.count or not settings.floor_sigma_spread:
        return _solve(observations, settings, problem, state, progress)
    fit = _solve(observations, settings, problem, state, progress, _NEAR)
    modes = problem.layout.modes
    factor = most_likely_scale(
        fit.state.values[modes], fit.covariance[modes, modes], settings.floor_sigma_spread
    )
    return _solve(observations, settings, *_with_floor(fit, factor), progress)


def _solve(
    observations: Observations,
    settings: JointSettings,
    problem: Problem,
    state: State,
    progress: Callable[[int, float], None],
    short: float = SHORT,
    damping: float = COLD_DAMPING,
) -> JointFit:
    valleys = settings.follows_valleys
    solution = solve(problem, state, progress, short, follows_valleys=valleys, damping=damping)
    return JointFit(observations, settings, problem, solution, solution.factorisation.global_covariance())


def _with_floor(fit: JointFit, factor: float) -> tuple[Problem, State]:
    """Return the problem with other standard deviations of floor and tape, and the floor as its start."""
    layout, values = fit.problem.layout, fit.state.values.copy()
    values[layout.modes] /= factor
    layout = replace(widen_tape(layout, fit.state, fit.covariance), floor=layout.floor.scaled(factor))
    problem = replace(fit.problem, layout=layout)
    return problem, replace(fit.state, values=values)


def without_unseen(observations: Observations) -> Observations:
    """Return the observations without calibration points that no camera saw: they determine nothing."""
    seen = np.unique(np.concatenate([sightings.point for sightings in observations.sightings]))
    seen = seen[seen >= 0]
    numbers = np.full(len(observations.points) + 1, -1)
    numbers[seen] = np.arange(len(seen))
    return replace(
        observations,
        points=tuple(observations.points[number] for number in seen.tolist()),
        sightings=tuple(
            replace(sightings, point=numbers[sightings.point]) for sightings in observations.sightings
        ),
    )


def _build(
    observations: Observations, settings: JointSettings, placed: list[PlacedCamera]
) -> tuple[Problem, State]:
    """Return the problem and its start."""
    paths, knots, numbers = start_paths(observations, placed, settings)
    layout = make_layout(observations, settings, _floor(placed, settings), len(paths) > 0)
    stationary = [sightings.point for sightings in observations.sightings]
    factors = _make_factors(observations, settings, Kind.STATIONARY, stationary)
    factors += _make_factors(observations, settings, Kind.FLOOR, numbers)
    factors.sort(key=lambda one: one.camera)
    if lost := sorted(set(range(len(placed))) - {own.camera for own in factors}):
        raise UnplacedError(observations, lost)
    trajectories = Trajectories(
        len(observations.points), paths, settings.acceleration_sigma, settings.turn_sigma
    )
    points = make_point_factors(observations.points, observations.tape, settings.point_tilt_sigma_rad)
    values = layout.mean.copy()
    for block, camera_pose in zip(layout.cameras, placed, strict=True):
        values[block.start + 3 : block.start + 6] = camera_pose.origin_m
        values[block.lens][4:] = camera_pose.lens.D
    turns = np.stack([camera_pose.camera_from_world for camera_pose in placed])
    positions_m, headings_rad = rough_points(observations, placed)
    state = State(values, turns, positions_m, level_turns(headings_rad), knots)
    blocks = find_blocks(layout, trajectories, factors) if observations.in_hall else ()
    return Problem(layout, trajectories, tuple(factors), points, blocks), state


def _make_factors(
    observations: Observations, settings: JointSettings, kind: Kind, trajectories: list[Indices]
) -> list[SightingFactors]:
    """Return the factors of one kind; ``trajectories`` has that of each sighting of each camera, or -1."""
    factors = []
    # Only an average over many frames has less noise than the errors of print and lens.
    floor_px = settings.corner_floor_px if kind is Kind.STATIONARY else 0.0
    for camera, (sightings, trajectory) in enumerate(zip(observations.sightings, trajectories, strict=True)):
        recordings = observations.recording_of(sightings)
        for recording in np.unique(recordings[trajectory >= 0]).tolist():
            rows = (trajectory >= 0) & (recordings == recording)
            own = sightings.select(rows), trajectory[rows], kind
            made = make_sighting_factors(camera, *own, observations.bodies, floor_px, recording)
            factors.append(at_one_instant(made) if observations.cameras[camera].known_row_s else made)
    return factors


def _floor(placed: list[PlacedCamera], settings: JointSettings) -> FloorField:
    points_m = np.concatenate([camera.points_m[:, :2] for camera in placed])
    return usual_floor(points_m[np.isfinite(points_m).all(axis=1)], settings)


def usual_floor(points_m: Array, settings: JointSettings) -> FloorField:
    """Return the field of a floor around places (n, 2) on it."""
    low_m, high_m = np.percentile(points_m, [1, 99], axis=0)
    low_m, high_m = low_m - _BEYOND_M, high_m + _BEYOND_M
    # The number of modes must not grow with a hall: only its longer waves are estimated.
    least_m = float(np.sqrt(np.prod(high_m - low_m) / _MOST_LENGTHS))
    length_m = max(settings.floor_length_m, least_m)
    return make_floor_field(low_m, high_m, settings.floor_sigma_m, length_m)
