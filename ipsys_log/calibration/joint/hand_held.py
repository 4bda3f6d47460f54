"""Cameras from a body that is carried about by hand: a board or a marker in free motion.

Nothing is known of the world: the first camera is its origin, and the body gives the scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.floor_field import make_floor_field
from ipsys_log.calibration.joint.observations import Observations, Sightings
from ipsys_log.calibration.joint.parameters import Layout, State, make_layout
from ipsys_log.calibration.joint.path_start import cover_times, smooth_knots
from ipsys_log.calibration.joint.point_factors import make_point_factors
from ipsys_log.calibration.joint.problem import Problem
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.sighting_factors import make_sighting_factors
from ipsys_log.calibration.joint.solver import solve
from ipsys_log.calibration.joint.trajectories import Kind, Paths, Trajectories
from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.vision.lenses import undistort

# Views of two cameras within this time show nearly the same pose of the body.
_SAME_TIME_S = 0.05
_POSE_M, _POSE_RAD = 0.01, 0.02


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
    observations : sightings of the body ``0``. The calibration points need no measurements: the sightings
        of a point are those of one unknown pose.
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
    solution = solve(problem, state, progress)
    return JointFit(observations, settings, problem, solution, solution.factorisation.global_covariance())


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
    number = np.maximum(sightings.point, 0)
    factors = make_sighting_factors(camera, sightings, number, kind, fit.observations.bodies, 0.0)
    units = np.broadcast_to(np.eye(visible[0].size), factors.whitening.shape)
    problem = fit.problem
    errors_px = replace(factors, whitening=units).residuals(fit.state, problem.layout, problem.trajectories)
    return np.where(visible, errors_px.reshape(visible.shape), np.nan)


def _view(observations: Observations, camera: int) -> Array:
    """Return ``camera_from_body`` (n, 4, 4) of each sighting."""
    sightings, lens = observations.sightings[camera], observations.cameras[camera].lens
    poses = np.tile(np.eye(4), (len(sightings), 1, 1))
    for row, (body, pixels) in enumerate(zip(sightings.body.tolist(), sightings.pixels, strict=True)):
        visible = np.isfinite(pixels).all(axis=1)
        uv = undistort(pixels[visible], lens)
        points_m = observations.bodies[body].points_m[visible]
        good, turn, shift_m = cv2.solvePnP(points_m, uv, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
        poses[row] = np.nan
        if good:
            poses[row] = np.eye(4)
            poses[row, :3, :3], poses[row, :3, 3] = cv2.Rodrigues(turn)[0], shift_m[:, 0]
    return poses


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
        acceleration_sigma=settings.acceleration_sigma,
        turn_sigma=settings.turn_sigma,
        free_paths=paths,
        free_turns=free_turns,
    )
    factors = []
    for camera, sightings in enumerate(observations.sightings):
        for kind, rows in ((Kind.STATIONARY, sightings.point >= 0), (Kind.FREE, sightings.point < 0)):
            if rows.any():
                own = sightings.select(rows)
                number = np.maximum(own.point, 0)
                factors.append(
                    make_sighting_factors(
                        camera, own, number, kind, observations.bodies, settings.corner_floor_px
                    )
                )
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
    """Return a path through all moving sightings, its mean orientation (1, 3, 3), and its knots (k, 6)."""
    rows = [
        (sightings.point < 0) & np.isfinite(own).all(axis=(1, 2))
        for sightings, own in zip(observations.sightings, world, strict=True)
    ]
    times_s = np.concatenate(
        [one.times_s[mask] for one, mask in zip(observations.sightings, rows, strict=True)]
    )
    if not len(times_s):
        return Trajectories(0).free_paths, np.zeros((0, 3, 3)), np.zeros((0, 6))
    poses = np.concatenate([own[mask] for own, mask in zip(world, rows, strict=True)])
    turns = Rotation.from_matrix(poses[:, :3, :3])
    # Rotation vectors are smooth up to half a turn from the orientation in the middle of the motion.
    middle = turns[int(np.abs(turns.as_quat() @ turns.as_quat().T).sum(axis=1).argmax())]
    vectors = (turns * middle.inv()).as_rotvec()
    paths = cover_times(times_s, step_s)
    places = np.concatenate([poses[:, :3, 3], vectors], axis=1)
    trajectories = Trajectories(
        0,
        acceleration_sigma=settings.acceleration_sigma,
        turn_sigma=settings.turn_sigma,
        free_paths=paths,
    )
    sigmas = np.repeat([_POSE_M, _POSE_RAD], 3)
    numbers = np.zeros(len(times_s), dtype=np.intp)
    knots = smooth_knots(paths, numbers, times_s, places, sigmas, trajectories)
    return paths, middle.as_matrix()[None], knots
