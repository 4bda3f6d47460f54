"""The joint calibration of a lab: from observations to cameras, floor and their covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.rotations import level_turns
from ipsys_log.joint.floor_field import FloorField, make_floor_field
from ipsys_log.joint.floor_unevenness import most_likely_scale
from ipsys_log.joint.observations import Observations
from ipsys_log.joint.parameters import State, make_layout
from ipsys_log.joint.path_start import start_paths
from ipsys_log.joint.point_factors import make_point_factors
from ipsys_log.joint.problem import Problem, find_blocks
from ipsys_log.joint.refusals import check_observations, check_spread, explain
from ipsys_log.joint.settings import JointSettings
from ipsys_log.joint.sighting_factors import make_sighting_factors
from ipsys_log.joint.solver import SHORT, ConvergenceError, Solution, solve
from ipsys_log.joint.start import PlacedCamera, place_cameras
from ipsys_log.joint.tape_scale import widen_tape
from ipsys_log.joint.trajectories import Kind, Trajectories

__all__ = ["JointFit", "fit_jointly"]

Array = NDArray[np.float64]

# The field of the floor reaches this far beyond the outermost place of a marker.
_BEYOND_M = 1.0
# The largest area of the field, in squares of its correlation length: 62 m^2 at the usual length.
_MOST_LENGTHS = 250
# Before the wobble of robots is known from their poses, a step need not be so exact.
_ROUGH = 0.3
# The same before the unevenness of the floor is known.
_NEAR = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """The result of a joint calibration.

    ``covariance`` (g, g) is that of the global unknowns, in the order of ``problem.layout``.
    """

    observations: Observations
    settings: JointSettings
    problem: Problem
    solution: Solution
    covariance: Array

    @property
    def state(self) -> State:
        """The estimated values of all unknowns."""
        return self.solution.state


def fit_jointly(
    observations: Observations,
    settings: JointSettings | None = None,
    progress: Callable[[int, float], None] = lambda step, cost: None,
) -> JointFit:
    """Estimate all cameras of a lab, the floor and the places of the markers together.

    Parameters
    ----------
    observations : cameras, markers, calibration points, and sightings.
    settings : prior standard deviations; None: the defaults.
    progress : called with the number of steps and the cost after each step.

    Raises
    ------
    FitError
        The observations do not determine the cameras.
    """
    check_observations(observations)
    observations = _without_unseen(observations)
    try:
        return _fit(observations, settings or JointSettings(), progress)
    except ConvergenceError as error:
        raise explain(error, observations) from error


def _fit(
    observations: Observations, settings: JointSettings, progress: Callable[[int, float], None]
) -> JointFit:
    placed = place_cameras(observations)
    check_spread(observations, placed)
    problem, state = _build(observations, settings, placed)
    if len(problem.trajectories.paths):
        # The wobble of a robot acts on its corners by the poses, so that these come first.
        tilts = settings.wobble_sigma_rad, settings.wobble_time_s
        problem = problem.reweighted(state, *tilts)
        state = solve(problem, state, progress, _ROUGH, observations.in_hall).state
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
) -> JointFit:
    solution = solve(problem, state, progress, short)
    return JointFit(observations, settings, problem, solution, solution.factorisation.global_covariance())


def _with_floor(fit: JointFit, factor: float) -> tuple[Problem, State]:
    """Return the problem with other standard deviations of floor and tape, and the floor as its start."""
    layout, values = fit.problem.layout, fit.state.values.copy()
    values[layout.modes] /= factor
    layout = replace(widen_tape(layout, fit.state, fit.covariance), floor=layout.floor.scaled(factor))
    problem = replace(fit.problem, layout=layout)
    return problem, replace(fit.state, values=values)


def _without_unseen(observations: Observations) -> Observations:
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
    factors = []
    for camera, (sightings, path) in enumerate(zip(observations.sightings, numbers, strict=True)):
        for kind, trajectory in ((Kind.STATIONARY, sightings.point), (Kind.FLOOR, path)):
            rows = trajectory >= 0
            if rows.any():
                own = sightings.select(rows), trajectory[rows], kind
                # Only an average over many frames has less noise than the errors of print and lens.
                floor_px = settings.corner_floor_px if kind is Kind.STATIONARY else 0.0
                factors.append(make_sighting_factors(camera, *own, observations.bodies, floor_px))
    trajectories = Trajectories(
        len(observations.points), paths, settings.acceleration_sigma, settings.turn_sigma
    )
    points = make_point_factors(observations.points, observations.tape, settings.point_tilt_sigma_rad)
    values = layout.mean.copy()
    for block, camera_pose in zip(layout.cameras, placed, strict=True):
        values[block.start + 3 : block.start + 6] = camera_pose.origin_m
        values[block.lens][4:] = camera_pose.lens.D
    turns = np.stack([camera_pose.camera_from_world for camera_pose in placed])
    positions_m, headings_rad = _point_starts(observations, placed)
    state = State(values, turns, positions_m, level_turns(headings_rad), knots)
    blocks = find_blocks(layout, trajectories, factors) if observations.in_hall else ()
    return Problem(layout, trajectories, tuple(factors), points, blocks), state


def _floor(placed: list[PlacedCamera], settings: JointSettings) -> FloorField:
    points_m = np.concatenate([camera.points_m[:, :2] for camera in placed])
    points_m = points_m[np.isfinite(points_m).all(axis=1)]
    low_m, high_m = np.percentile(points_m, [1, 99], axis=0)
    low_m, high_m = low_m - _BEYOND_M, high_m + _BEYOND_M
    # The number of modes must not grow with a hall: only its longer waves are estimated.
    least_m = float(np.sqrt(np.prod(high_m - low_m) / _MOST_LENGTHS))
    length_m = max(settings.floor_length_m, least_m)
    return make_floor_field(low_m, high_m, settings.floor_sigma_m, length_m)


def _point_starts(observations: Observations, placed: list[PlacedCamera]) -> tuple[Array, Array]:
    """Return positions (t, 3) and headings (t,) of the calibration points, as the cameras see them."""
    count = len(observations.points)
    sums, turns, seen = np.zeros((count, 3)), np.zeros(count, dtype=complex), np.zeros(count)
    for camera, sightings in zip(placed, observations.sightings, strict=True):
        for row in np.flatnonzero(sightings.point >= 0).tolist():
            point = observations.points[int(sightings.point[row])]
            place_m = camera.points_m[row]
            if point.height_m is not None:
                along = (point.height_m - camera.origin_m[2]) / camera.rays[row, 2]
                place_m = camera.origin_m + along * camera.rays[row]
            if np.isfinite(place_m).all():
                sums[sightings.point[row]] += place_m
                turns[sightings.point[row]] += np.exp(1j * camera.headings_rad[row])
                seen[sightings.point[row]] += 1
    return sums / np.maximum(seen, 1)[:, None], np.angle(turns)
