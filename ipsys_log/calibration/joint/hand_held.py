"""Cameras from a body that is carried about by hand: a board or a marker in free motion.

Nothing is known of the world: the first camera is its origin, and the body gives the scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.floor_field import make_floor_field
from ipsys_log.calibration.joint.observations import Observations, Sightings
from ipsys_log.calibration.joint.parameters import Layout, State, make_layout
from ipsys_log.calibration.joint.path_start import PAD_S, cover_times, smooth_knots
from ipsys_log.calibration.joint.point_factors import make_point_factors
from ipsys_log.calibration.joint.problem import Problem
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.sighting_factors import at_one_instant, make_sighting_factors
from ipsys_log.calibration.joint.solver import solve
from ipsys_log.calibration.joint.trajectories import Kind, Paths, Trajectories
from ipsys_log.errors import FitError
from ipsys_log.messages import Array, Indices
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.poses import make_pose, rotation

# Views of two cameras within this time show nearly the same pose of the body.
_SAME_TIME_S = 0.05
_POSE_M, _POSE_RAD = 0.01, 0.02
# Sightings of a camera within this time are those of one frame, by the rows of a rolling shutter.
_ONE_FRAME_S = 0.015
# The smallest number of points that have a pose, and the share of their extent up to which they are a plane.
_LEAST_POINTS, _FLAT = 4, 1e-3
# A longer time without sightings divides a path. The parts of a path that turns far are not shorter.
_GAP_S, _SHORTEST_PART_S = 1.0, 0.5
# A part with fewer instants, or of less than two intervals of knots, has no path.
_LEAST_SIGHTINGS = 6
_FAR_RAD = 2.0
_FEW = 200
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
    views = [_view(observations, camera) for camera in range(len(observations.cameras))]
    cameras = _chain_cameras(observations, views) if camera_poses is None else list(camera_poses)
    problem, state = _build(observations, settings, cameras, views, step_s)
    if camera_poses is not None:
        problem = replace(problem, layout=_with_known_poses(problem.layout))
    return _solve(observations, settings, problem, state, progress)


def _solve(
    observations: Observations,
    settings: JointSettings,
    problem: Problem,
    state: State,
    progress: Callable[[int, float], None],
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
    for rows in _frames(sightings):
        counts[rows] = len(rows)
    return np.asarray(np.sqrt(counts))


def fit_motion(fit: JointFit, progress: Callable[[int, float], None] = lambda step, cost: None) -> JointFit:
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
            while (trial := _with_factor(best, names, factor, progress)) is not None:
                if _improbability(trial) > _improbability(best) - _CLEARLY:
                    break
                best = trial
    return best


def _with_factor(
    fit: JointFit, names: Sequence[str], factor: float, progress: Callable[[int, float], None]
) -> JointFit | None:
    """Return the fit with some settings times a factor; None beyond their limits, or without a result."""
    changed = {name: getattr(fit.settings, name) * factor for name in names}
    if not all(_LIMITS[name][0] <= value <= _LIMITS[name][1] for name, value in changed.items()):
        return None
    settings = replace(fit.settings, **changed)
    densities = {name: getattr(settings, name) for name in ("jerk_density", "turn_jerk_density")}
    problem = replace(fit.problem, trajectories=replace(fit.problem.trajectories, **densities))
    try:
        return _solve(fit.observations, settings, problem, fit.state, progress)
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


def corner_sigma(fit: JointFit) -> float:
    """Return the standard deviation of a corner in px: errors within images, beside any pose of the body."""
    squares, freedom = 0.0, 0
    problem = fit.problem
    for weighted in problem.sightings:
        visible = np.repeat(np.isfinite(weighted.sightings.pixels[:, :, 0]), 2, axis=1)
        factors = replace(weighted, whitening=np.eye(visible.shape[1]) * visible[:, :, None])
        place = factors.place(fit.state, problem.layout, problem.trajectories)
        by_pose = factors.slopes(place, fit.state, problem.layout).by_pose * visible[:, :, None]
        errors_px = factors.residuals(fit.state, problem.layout, problem.trajectories)
        axes, _ = np.linalg.qr(by_pose)
        rest = errors_px - (axes @ (axes.swapaxes(1, 2) @ errors_px[:, :, None]))[:, :, 0]
        squares += float((rest**2).sum())
        freedom += int(visible.sum()) - 6 * len(visible)
    return float(np.sqrt(squares / max(freedom, 1)))


def predict_errors(fit: JointFit, camera: int, sightings: Sightings) -> Array:
    """Return the reprojection errors of sightings, also of those that the fit did not use.

    Parameters
    ----------
    fit : cameras and poses of the body, by :func:`fit_hand_held`.
    camera : index of the camera.
    sightings : sightings of the body, with p points each, that all move or are all stationary.

    Returns
    -------
    (n, p, 2) in px; NaN for a point that is not visible.
    """
    visible = np.isfinite(sightings.pixels)
    kind = Kind.FREE if (sightings.point < 0).all() else Kind.STATIONARY
    paths = fit.problem.trajectories.free_paths
    number = sightings.point if kind is Kind.STATIONARY else _path_at(paths, sightings.times_s)
    factors = make_sighting_factors(camera, sightings, number, kind, fit.observations.bodies, 0.0)
    units = np.broadcast_to(np.eye(visible[0].size), factors.whitening.shape)
    problem = fit.problem
    errors_px = replace(factors, whitening=units).residuals(fit.state, problem.layout, problem.trajectories)
    return np.where(visible, errors_px.reshape(visible.shape), np.nan)


def hold_out_halves(
    fit: JointFit, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Array]:
    """Return the reprojection errors (n, p, 2) of the moving sightings of each camera, in fits without them.

    Each fit leaves out half of the time of one camera. The path then comes from the other cameras, and the
    pose and the clock of the camera from its other half. Sightings count at which another camera sees the
    body at nearly the same time: nothing else predicts its pose.
    """
    observations, errors = fit.observations, []
    count = len(observations.cameras)
    paths = fit.problem.trajectories.free_paths
    step_s = float(paths.steps_s[0])
    for camera, own in enumerate(observations.sightings):
        moving = (own.point < 0) & _covers(paths, own.times_s)
        half_s = np.median(own.times_s[moving])
        shared = _shares(observations, camera)
        parts = []
        for number, out in enumerate((moving & (own.times_s < half_s), moving & (own.times_s >= half_s))):
            kept = [*observations.sightings]
            kept[camera] = own.select(~out)
            rest = fit_hand_held(replace(observations, sightings=tuple(kept)), fit.settings, step_s)
            parts.append(predict_errors(rest, camera, own.select(out & shared)))
            progress(2 * camera + number + 1, 2 * count)
        errors.append(np.concatenate(parts))
    return errors


def _shares(observations: Observations, camera: int) -> NDArray[np.bool_]:
    """Return a mask of the sightings of a camera near which another camera sees the body."""
    others = [own for number, own in enumerate(observations.sightings) if number != camera]
    known_s = np.sort(np.concatenate([own.times_s[own.point < 0] for own in others]))
    times_s = observations.sightings[camera].times_s
    if not len(known_s):
        return np.zeros(len(times_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(known_s, times_s), 1, max(len(known_s) - 1, 1))
    near_s = np.minimum(
        *(np.abs(times_s - known_s[np.minimum(n, len(known_s) - 1)]) for n in (after, after - 1))
    )
    return np.asarray(near_s < _SAME_TIME_S)


def _view(observations: Observations, camera: int) -> Array:
    """Return ``camera_from_body`` (n, 4, 4) of each sighting, from all sightings of its frame."""
    sightings, lens = observations.sightings[camera], observations.cameras[camera].lens
    poses = np.full((len(sightings), 4, 4), np.nan)
    for rows in _frames(sightings):
        visible = np.isfinite(sightings.pixels[rows, :, 0])
        bodies = [observations.bodies[body].points_m for body in sightings.body[rows].tolist()]
        points_m, pixels = np.stack(bodies)[visible], sightings.pixels[rows][visible]
        pose = _pose_of(points_m, undistort(pixels, lens))
        if pose is not None:
            poses[rows] = pose
    return poses


def _frames(sightings: Sightings) -> list[list[int]]:
    """Return the rows of each frame, whose sightings have nearly the same time."""
    order = np.argsort(sightings.times_s, kind="stable")
    apart = np.diff(sightings.times_s[order]) > _ONE_FRAME_S
    apart |= np.diff(sightings.point[order]) != 0
    return [rows.tolist() for rows in np.split(order, np.flatnonzero(apart) + 1) if len(rows)]


def _pose_of(points_m: Array, uv: Array) -> Array | None:
    """Return ``camera_from_body`` (4, 4) from points (n, 3) and their undistorted places (n, 2), or None."""
    usable = np.isfinite(uv).all(axis=1)
    points_m, uv = points_m[usable], uv[usable]
    if len(points_m) < _LEAST_POINTS:
        return None
    spread_m = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    flat = spread_m[2] < _FLAT * spread_m[0]
    method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_EPNP
    good, turn, shift_m = cv2.solvePnP(points_m, uv, np.eye(3), np.zeros(5), flags=method)
    return make_pose(rotation(np.ravel(turn)), np.ravel(shift_m)) if good else None


def _chain_cameras(observations: Observations, views: list[Array]) -> list[Array]:
    """Return ``camera_from_world`` (4, 4) of each camera; the first camera is the origin."""
    cameras: dict[int, Array] = {0: np.eye(4)}
    while len(cameras) < len(views):
        pairs = {
            (known, new): _relative_poses(observations, views, known, new)
            for known in cameras
            for new in range(len(views))
            if new not in cameras
        }
        known, new = max(pairs, key=lambda pair: len(pairs[pair]))
        if not len(pairs[known, new]):
            names = ", ".join(
                camera.name for n, camera in enumerate(observations.cameras) if n not in cameras
            )
            raise FitError(
                f"camera {names}: it never sees the board at the same time as the other cameras; show the "
                "board to both"
            )
        cameras[new] = _central_pose(pairs[known, new]) @ cameras[known]
    return [cameras[camera] for camera in range(len(views))]


def _relative_poses(observations: Observations, views: list[Array], known: int, new: int) -> Array:
    """Return ``new_from_known`` (n, 4, 4) from views at the same point or the same time."""
    first, second = observations.sightings[known], observations.sightings[new]
    together = np.abs(first.times_s[:, None] - second.times_s) < _SAME_TIME_S
    same = np.where(first.point[:, None] >= 0, first.point[:, None] == second.point, together)
    rows, columns = np.nonzero(same & (first.body[:, None] == second.body))
    relative = views[new][columns] @ np.linalg.inv(views[known][rows])
    return np.asarray(relative[np.isfinite(relative).all(axis=(1, 2))])


def _central_pose(poses: Array) -> Array:
    """Return the pose with the smallest median distance from the others."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    distances = np.stack(
        [
            np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
            + (turns * Rotation.from_matrix(pose[:3, :3]).inv()).magnitude()
            for pose in poses
        ]
    )
    return np.asarray(poses[np.median(distances, axis=1).argmin()])


def _build(
    observations: Observations,
    settings: JointSettings,
    cameras: list[Array],
    views: list[Array],
    step_s: float,
) -> tuple[Problem, State]:
    layout = _layout(observations, settings)
    world = [np.linalg.inv(camera) @ view for camera, view in zip(cameras, views, strict=True)]
    paths, free_turns, free_knots = _start_path(observations, world, settings, step_s)
    trajectories = Trajectories(
        len(observations.points),
        free_paths=paths,
        free_turns=free_turns,
        jerk_density=settings.jerk_density,
        turn_jerk_density=settings.turn_jerk_density,
    )
    factors = []
    for camera, sightings in enumerate(observations.sightings):
        moving = (sightings.point < 0) & _covers(paths, sightings.times_s)
        for kind, rows in ((Kind.STATIONARY, sightings.point >= 0), (Kind.FREE, moving)):
            if rows.any():
                own = sightings.select(rows)
                number = own.point if kind is Kind.STATIONARY else _path_at(paths, own.times_s)
                floor_px = settings.corner_floor_px if kind is Kind.STATIONARY else 0.0
                made = make_sighting_factors(camera, own, number, kind, observations.bodies, floor_px)
                factors.append(at_one_instant(made) if observations.cameras[camera].known_row_s else made)
    values = layout.mean.copy()
    for block, camera_pose in zip(layout.cameras, cameras, strict=True):
        values[block.start + 3 : block.start + 6] = -camera_pose[:3, :3].T @ camera_pose[:3, 3]
    poses = _start_points(observations, world)
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


def _start_points(observations: Observations, world: list[Array]) -> Array:
    """Return ``world_from_body`` (t, 4, 4) of each point, from the camera that comes first."""
    poses = np.tile(np.eye(4), (len(observations.points), 1, 1))
    for sightings, own in reversed(list(zip(observations.sightings, world, strict=True))):
        rows = (sightings.point >= 0) & np.isfinite(own).all(axis=(1, 2))
        poses[sightings.point[rows]] = own[rows]
    return poses


def _start_path(
    observations: Observations, world: list[Array], settings: JointSettings, step_s: float
) -> tuple[Paths, Array, Array]:
    """Return paths through all moving sightings, their mean orientations (i, 3, 3), and knots (k, 6)."""
    times_s, poses = _moving_poses(observations, world)
    if not len(times_s):
        return Trajectories(0).free_paths, np.zeros((0, 3, 3)), np.zeros((0, 6))
    parts = [
        rows
        for rows in _divide(times_s, Rotation.from_matrix(poses[:, :3, :3]), np.arange(len(times_s)))
        if len(np.unique(times_s[rows])) >= _LEAST_SIGHTINGS and np.ptp(times_s[rows]) > 2 * step_s
    ]
    columns, first = [], 0
    for rows in parts:
        own = cover_times(times_s[rows], step_s)
        columns.append((float(own.starts_s[0]), step_s, first, int(own.counts[0])))
        first += int(own.counts[0])
    starts_s, steps_s, firsts, counts = (np.array(column) for column in zip(*columns, strict=True))
    paths = Paths(starts_s, steps_s, firsts, counts, np.zeros(len(parts), dtype=np.intp))
    middles = [_middle(Rotation.from_matrix(poses[rows, :3, :3])) for rows in parts]
    near = _covers(paths, times_s)
    times_s, poses = times_s[near], poses[near]
    numbers = _path_at(paths, times_s)
    turned = [
        (Rotation.from_matrix(pose[:3, :3]) * middles[number].inv()).as_rotvec()
        for pose, number in zip(poses, numbers.tolist(), strict=True)
    ]
    trajectories = Trajectories(
        0,
        free_paths=paths,
        jerk_density=settings.jerk_density,
        turn_jerk_density=settings.turn_jerk_density,
    )
    sigmas = np.repeat([_POSE_M, _POSE_RAD], 3)
    places = np.concatenate([poses[:, :3, 3], np.array(turned)], axis=1)
    knots = smooth_knots(paths, numbers, times_s, places, sigmas, trajectories)
    return paths, np.stack([middle.as_matrix() for middle in middles]), knots


def _moving_poses(observations: Observations, world: list[Array]) -> tuple[Array, Array]:
    """Return the times (n,) of the moving sightings, in order, and their poses in the world (n, 4, 4)."""
    rows = [
        (sightings.point < 0) & np.isfinite(own).all(axis=(1, 2))
        for sightings, own in zip(observations.sightings, world, strict=True)
    ]
    parts = list(zip(observations.sightings, world, rows, strict=True))
    times_s = np.concatenate([one.times_s[mask] for one, _, mask in parts])
    poses = np.concatenate([own[mask] for _, own, mask in parts])
    order = np.argsort(times_s, kind="stable")
    return times_s[order], poses[order]


def _divide(times_s: Array, turns: Rotation, rows: Indices) -> list[Indices]:
    """Divide the rows of a motion in halves until each part stays near one orientation.

    Rotation vectors are smooth up to half a turn from the orientation in the middle of a part.
    """
    cuts = np.flatnonzero(np.diff(times_s[rows]) > _GAP_S) + 1
    if len(cuts):
        return [part for own in np.split(rows, cuts) for part in _divide(times_s, turns, own)]
    own = turns[rows]
    angles = (own * _middle(own).inv()).magnitude()
    half_s = (times_s[rows[0]] + times_s[rows[-1]]) / 2
    if np.percentile(angles, 95) < _FAR_RAD or half_s - times_s[rows[0]] < _SHORTEST_PART_S:
        return [rows]
    early = times_s[rows] <= half_s
    return [*_divide(times_s, turns, rows[early]), *_divide(times_s, turns, rows[~early])]


def _middle(turns: Rotation) -> Rotation:
    """Return the orientation that is nearest to all others."""
    some = turns[:: max(1, len(turns) // _FEW)]
    return some[int(np.abs(some.as_quat() @ turns.as_quat().T).sum(axis=1).argmax())]


def _covers(paths: Paths, times_s: Array) -> NDArray[np.bool_]:
    """Return a mask of the times at which a path has sightings."""
    ends_s = paths.starts_s + (paths.counts - 2) * paths.steps_s - PAD_S
    inside = (times_s[:, None] >= paths.starts_s + PAD_S) & (times_s[:, None] <= ends_s)
    return np.asarray(inside.any(axis=1))


def _path_at(paths: Paths, times_s: Array) -> Indices:
    """Return the path of each time: the last one that has begun."""
    begun = np.searchsorted(paths.starts_s + PAD_S, times_s, side="right") - 1
    return np.asarray(np.clip(begun, 0, len(paths) - 1))
