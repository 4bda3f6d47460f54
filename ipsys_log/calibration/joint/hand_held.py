"""Cameras from a body that is carried about by hand: a board or a marker in free motion.

Nothing is known of the world: the first camera is its origin, and the body gives the scale.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.floor_field import make_floor_field
from ipsys_log.calibration.joint.hand_held_start import (
    chain_cameras,
    covers,
    frames_of,
    path_at,
    start_path,
    start_points,
    view_body,
)
from ipsys_log.calibration.joint.observations import Observations, Sightings
from ipsys_log.calibration.joint.parameters import Layout, State, make_layout
from ipsys_log.calibration.joint.point_factors import make_point_factors
from ipsys_log.calibration.joint.problem import Problem
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.sighting_factors import at_one_instant, make_sighting_factors
from ipsys_log.calibration.joint.solver import solve
from ipsys_log.calibration.joint.trajectories import Kind, Trajectories
from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.vision.poses import make_pose

# Before the velocity of the body is known, a step need not be so exact, in standard deviations.
_ROUGH, _NEAR = 0.3, 0.03
# Factor between two trials of a setting, its limits, and the least gain of evidence that counts.
_FACTOR, _CLEARLY = 3.0, 1.0
_LIMITS = {
    "jerk_density": (0.1, 300.0),
    "turn_jerk_density": (0.3, 1000.0),
    "stamp_jitter_s": (1e-5, 0.011),
}


def fit_hand_held(
    observations: Observations,
    settings: JointSettings | None = None,
    step_s: float = 0.1,
    progress: Callable[[int, float], None] = lambda step, cost: None,
    camera_poses: Sequence[Array] | None = None,
) -> JointFit:
    """Estimate cameras that see one body, which stands at some points and else moves freely.

    Parameters
    ----------
    observations : sightings of the body. Its parts, such as its markers, are bodies in the same axes. The
        calibration points need no measurements: the sightings of a point are those of one unknown pose.
    settings : prior standard deviations; None: the defaults.
    step_s : time between the knots of the path.
    progress : called with the number of steps and the cost after each step.
    camera_poses : ``camera_from_world`` (4, 4) of each camera, which remain constant; None: the fit estimates
        them, and the first camera is the world.

    Raises
    ------
    FitError
        A camera has no view at the same time as the others.
    """
    settings = settings or JointSettings()
    views = [view_body(observations, camera) for camera in range(len(observations.cameras))]
    cameras = chain_cameras(observations, views) if camera_poses is None else list(camera_poses)
    problem, state = _build(observations, settings, cameras, views, step_s)
    if camera_poses is not None:
        problem = replace(problem, layout=_with_known_poses(problem.layout))
    return _solve(observations, settings, problem, state, progress)


def fit_path(cameras: JointFit, observations: Observations, step_s: float) -> JointFit:
    """Estimate the path of the body in other sightings of the same cameras, which remain constant."""
    views = [view_body(observations, camera) for camera in range(len(observations.cameras))]
    known, poses = cameras.problem.layout, []
    for block, turn in zip(known.cameras, cameras.state.camera_turns, strict=True):
        poses.append(make_pose(turn, -turn @ cameras.state.values[block.start + 3 : block.start + 6]))
    problem, state = _build(observations, cameras.settings, poses, views, step_s)
    layout = replace(known, mean=cameras.state.values, sigma=np.zeros(len(known.sigma)))
    state = replace(state, values=cameras.state.values)
    return _solve(observations, cameras.settings, replace(problem, layout=layout), state)


def _solve(
    observations: Observations,
    settings: JointSettings,
    problem: Problem,
    state: State,
    progress: Callable[[int, float], None] = lambda step, cost: None,
) -> JointFit:
    """Solve with the noise of the frames' times, which acts on the corners by the velocity of the body."""
    if len(problem.trajectories.free_paths) and settings.stamp_jitter_s:
        for short in (_ROUGH, _NEAR):
            problem = _with_jitter(problem, state, settings.stamp_jitter_s)
            state = solve(problem, state, progress, short).state
        problem = _with_jitter(problem, state, settings.stamp_jitter_s)
    solution = solve(problem, state, progress)
    return JointFit(observations, settings, problem, solution, solution.factorisation.global_covariance())


def _with_jitter(problem: Problem, state: State, jitter_s: float) -> Problem:
    """Return the problem with errors of the frames' times as noise of the corners.

    The markers of a frame share one error. White noise of their number times its variance has the same effect
    on all unknowns that change slowly.
    """
    return replace(
        problem,
        sightings=tuple(
            factors.jittered(
                state, problem.layout, problem.trajectories, jitter_s * _sharing(factors.sightings)
            )
            if factors.kind is Kind.FREE
            else factors
            for factors in problem.sightings
        ),
    )


def _sharing(sightings: Sightings) -> Array:
    """Return the root of the number of sightings in the frame of each sighting, (n,)."""
    counts = np.ones(len(sightings))
    for rows in frames_of(sightings):
        counts[rows] = len(rows)
    return np.asarray(np.sqrt(counts))


def fit_motion(fit: JointFit) -> JointFit:
    """Return the fit with the jerk of the body and the jitter of the stamps that the frames show.

    Both are standard deviations before the fit. Those are taken for which the observations are most likely,
    with all unknowns integrated out (the evidence). With too much jerk, the path follows the errors of the
    stamps; with too little, it cuts corners.

    References
    ----------
    MacKay, Bayesian interpolation, Neural Computation 1992, for the evidence.
    """
    best = fit
    for names in (("jerk_density", "turn_jerk_density"), ("stamp_jitter_s",)) * 2:
        for factor in (_FACTOR, 1 / _FACTOR):
            while (trial := _with_factor(best, names, factor)) is not None:
                if _improbability(trial) > _improbability(best) - _CLEARLY:
                    break
                best = trial
    return best


def _with_factor(fit: JointFit, names: Sequence[str], factor: float) -> JointFit | None:
    """Return the fit with some settings times a factor; None beyond their limits, or without a result."""
    changed = {name: getattr(fit.settings, name) * factor for name in names}
    if not all(_LIMITS[name][0] <= value <= _LIMITS[name][1] for name, value in changed.items()):
        return None
    settings = replace(fit.settings, **changed)
    densities = {name: getattr(settings, name) for name in ("jerk_density", "turn_jerk_density")}
    problem = replace(fit.problem, trajectories=replace(fit.problem.trajectories, **densities))
    try:
        return _solve(fit.observations, settings, problem, fit.state)
    except FitError:
        return None


def _improbability(fit: JointFit) -> float:
    """Return the negative logarithm of the evidence of a fit, less a constant for all settings."""
    trajectories = fit.problem.trajectories
    knots = trajectories.free_paths.knot_count - 3 * len(trajectories.free_paths)
    densities = trajectories.jerk_density * trajectories.turn_jerk_density
    normal = fit.solution.cost + fit.solution.factorisation.log_determinant() / 2
    weights = sum(factors.log_weights() for factors in fit.problem.sightings)
    return normal + 3 * knots * float(np.log(densities)) - weights


def _build(
    observations: Observations,
    settings: JointSettings,
    cameras: list[Array],
    views: list[Array],
    step_s: float,
) -> tuple[Problem, State]:
    layout = _layout(observations, settings)
    world = [np.linalg.inv(camera) @ view for camera, view in zip(cameras, views, strict=True)]
    paths, free_turns, free_knots = start_path(observations, world, settings, step_s)
    trajectories = Trajectories(
        len(observations.points),
        free_paths=paths,
        free_turns=free_turns,
        jerk_density=settings.jerk_density,
        turn_jerk_density=settings.turn_jerk_density,
    )
    factors = []
    for camera, sightings in enumerate(observations.sightings):
        moving = (sightings.point < 0) & covers(paths, sightings.times_s)
        for kind, rows in ((Kind.STATIONARY, sightings.point >= 0), (Kind.FREE, moving)):
            if rows.any():
                own = sightings.select(rows)
                number = own.point if kind is Kind.STATIONARY else path_at(paths, own.times_s)
                floor_px = settings.corner_floor_px if kind is Kind.STATIONARY else 0.0
                made = make_sighting_factors(camera, own, number, kind, observations.bodies, floor_px)
                factors.append(at_one_instant(made) if observations.cameras[camera].known_row_s else made)
    values = layout.mean.copy()
    for block, camera_pose in zip(layout.cameras, cameras, strict=True):
        values[block.start + 3 : block.start + 6] = -camera_pose[:3, :3].T @ camera_pose[:3, 3]
    poses = start_points(observations, world)
    state = State(
        values,
        np.stack([camera_pose[:3, :3] for camera_pose in cameras]),
        poses[:, :3, 3],
        poses[:, :3, :3],
        np.zeros((0, 3)),
        free_knots,
    )
    points = make_point_factors(observations.points, observations.tape, np.inf)
    return Problem(layout, trajectories, tuple(factors), points), state


def _layout(observations: Observations, settings: JointSettings) -> Layout:
    """Return the unknowns; the pose of the first camera is constant."""
    moving = any((sightings.point < 0).any() for sightings in observations.sightings)
    flat = make_floor_field(np.zeros(2), np.ones(2), 0.0, 1.0)
    layout = make_layout(observations, settings, flat, moving)
    sigma = layout.sigma.copy()
    sigma[:6] = 0.0
    sigma[layout.heights] = 0.0
    return replace(layout, sigma=sigma)


def _with_known_poses(layout: Layout) -> Layout:
    """Return the unknowns with constant poses of all cameras."""
    sigma = layout.sigma.copy()
    for block in layout.cameras:
        sigma[block.start : block.start + 6] = 0.0
    return replace(layout, sigma=sigma)
