"""Coordinates of a lab for cameras that are known to each other: from stationary markers with known poses."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ipsys_log.calibration.joint.fit import JointFit, usual_floor
from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.vision.poses import rotate, skew_matrices, turn_about_z

_ROUNDS = 20
_SHORT = 1e-12
# Two points that are nearer together than this define no heading.
_NEAR_M = 0.3
_POSE = 6


class Target(NamedTuple):
    """The known pose of a stationary marker in the lab.

    ``number`` is its point in the fit. ``position_m`` is (3,), ``turn`` (3, 3) is ``lab_from_marker``;
    ``sigmas`` (6,) are the standard deviations of the position and of a turn about the axes of the lab,
    infinity for what is not known.
    """

    number: int
    name: str
    position_m: Array
    turn: Array
    sigmas: Array


class LabFrame(NamedTuple):
    """The lab's coordinates in those of a fit.

    Attributes
    ----------
    turn, origin_m : ``fit_from_lab``: rotation (3, 3), and origin (3,).
    slopes : (6, g), changes of turn and origin, in axes of the fit, by the global unknowns.
    covariance : (6, 6), of both, for constant global unknowns.
    chi2, freedom : of the differences between poses and targets.
    worst : the name of the target with the largest difference, and this in standard deviations.
    """

    turn: Array
    origin_m: Array
    slopes: Array
    covariance: Array
    chi2: float
    freedom: int
    worst: tuple[str, float]


def find_frame(fit: JointFit, targets: Sequence[Target]) -> LabFrame:
    """Estimate the coordinates of the lab by weighted least squares over the stationary markers.

    Raises
    ------
    FitError
        The markers do not define the coordinates: fewer than two of them, or too near together.
    """
    poses = [_Pose(fit, target) for target in targets]
    turn, origin_m = _start(poses)
    for _ in range(_ROUNDS):
        parts = [pose.linearise(turn, origin_m) for pose in poses]
        information = sum(slopes.T @ weights @ slopes for slopes, weights, _ in parts)
        gradient = sum(slopes.T @ weights @ misses for slopes, weights, misses in parts)
        try:
            step: Array = -np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            raise FitError(_NO_FRAME) from error
        turn, origin_m = rotate(step[None, :3])[0] @ turn, origin_m + step[3:]
        if np.abs(step).max() < _SHORT:
            break
    inverse: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
    scores = [float(misses @ weights @ misses) for _, weights, misses in parts]
    worst = int(np.argmax(scores))
    freedom = sum(int(np.isfinite(pose.target.sigmas).sum()) for pose in poses) - _POSE
    slopes = np.zeros((_POSE, len(fit.covariance)))
    for pose, (by_frame, weights, _) in zip(poses, parts, strict=True):
        slopes += inverse @ by_frame.T @ weights @ pose.into_lab(turn) @ pose.by_global
    return LabFrame(
        turn, origin_m, -slopes, inverse, sum(scores), freedom, (targets[worst].name, scores[worst] ** 0.5)
    )


_NO_FRAME = "the measured points are too near together; measure two points some metres apart"


def first_camera(fit: JointFit) -> LabFrame:
    """Return the coordinates of the first camera: those of the fit."""
    none = np.zeros((_POSE, len(fit.covariance)))
    return LabFrame(np.eye(3), np.zeros(3), none, np.zeros((_POSE, _POSE)), 0.0, 0, ("", 0.0))


def relative_length(fit: JointFit, targets: Sequence[Target]) -> float:
    """Return by how much the targets are farther apart than in the fit, as a share of their distances."""
    known_m = np.array([target.position_m for target in targets])
    seen_m = fit.state.positions_m[[target.number for target in targets]]
    spreads_m = [float(np.sqrt(((own - own.mean(axis=0)) ** 2).sum())) for own in (known_m, seen_m)]
    return spreads_m[0] / spreads_m[1] - 1


class _Pose:
    """A stationary marker in the fit, and its target. Its own covariance is that for constant cameras."""

    def __init__(self, fit: JointFit, target: Target) -> None:
        self.target = target
        self.position_m = fit.state.positions_m[target.number]
        self.turn = fit.state.turns[target.number]
        factorisation = fit.solution.factorisation
        self.by_global, self.covariance = factorisation.local_from_global(_POSE * target.number, _POSE)

    def into_lab(self, turn: Array) -> Array:
        """Return the rotation (6, 6) of a motion and a turn from axes of the fit to those of the lab."""
        return np.asarray(np.kron(np.eye(2), turn.T), dtype=np.float64)

    def linearise(self, turn: Array, origin_m: Array) -> tuple[Array, Array, Array]:
        """Return derivatives (6, 6) of the differences by turn and origin, their weights, and them (6,)."""
        arm_m, known = self.position_m - origin_m, self.target
        misses = np.zeros(_POSE)
        misses[:3] = turn.T @ arm_m - known.position_m
        own = turn.T @ self.turn
        wanted = known.turn
        if np.isinf(known.sigmas[5]):
            heading_rad = np.arctan2(own[1, 0] - own[0, 1], own[0, 0] + own[1, 1])
            wanted = turn_about_z(float(heading_rad))
        misses[3:] = Rotation.from_matrix(own @ wanted.T).as_rotvec()
        slopes = np.zeros((_POSE, _POSE))
        slopes[:3, :3] = turn.T @ skew_matrices(arm_m)
        slopes[:3, 3:], slopes[3:, :3] = -turn.T, -turn.T
        seen = np.isfinite(known.sigmas)
        into = self.into_lab(turn)
        covariance = into @ self.covariance @ into.T + np.diag(np.where(seen, known.sigmas, 0.0) ** 2)
        weights = np.zeros((_POSE, _POSE))
        weights[np.ix_(seen, seen)] = np.linalg.inv(covariance[np.ix_(seen, seen)])
        return slopes, weights, misses


def _start(poses: Sequence[_Pose]) -> tuple[Array, Array]:
    """Return rough coordinates of the lab."""
    for pose in poses:
        if np.isfinite(pose.target.sigmas).all():
            turn = pose.turn @ pose.target.turn.T
            return turn, pose.position_m - turn @ pose.target.position_m
    known_m = np.array([pose.target.position_m for pose in poses]).reshape(-1, 3)
    seen_m = np.array([pose.position_m for pose in poses]).reshape(-1, 3)
    if len(poses) < 2 or np.linalg.norm(known_m - known_m[:1], axis=1).max() < _NEAR_M:
        raise FitError(_NO_FRAME)
    up = np.mean([pose.turn[:, 2] for pose in poses], axis=0)
    known_m, middle_m = known_m - known_m.mean(axis=0), seen_m.mean(axis=0)
    # A vertical line beside the points fixes the turn of few points in a plane.
    reach_m = float(np.linalg.norm(known_m, axis=1).max())
    ends_m = np.vstack([known_m, [0.0, 0.0, reach_m]])
    seen_ends_m = np.vstack([seen_m - middle_m, reach_m * up / np.linalg.norm(up)])
    turn = Rotation.align_vectors(seen_ends_m, ends_m)[0].as_matrix()
    first = poses[0].target.position_m - known_m[0]
    return turn, middle_m - turn @ first


def apply_frame(
    fit: JointFit, frame: LabFrame, tilt_sigma_rad: float, scale_sigma: float, middle_m: Array
) -> JointFit:
    """Return a fit in the coordinates of the lab, with a floor of the usual unevenness.

    Parameters
    ----------
    fit, frame : the fit, and the coordinates.
    tilt_sigma_rad : uncertain tilt of the lab's axes about its x and y axis.
    scale_sigma : relative uncertainty of all lengths of the fit.
    middle_m : (3,), the place in the lab that an error of the scale does not move.
    """
    layout, state = fit.problem.layout, fit.state
    tilt = frame.turn @ np.diag([tilt_sigma_rad**2, tilt_sigma_rad**2, 0.0]) @ frame.turn.T
    own = frame.covariance.copy()
    own[:3, :3] += tilt
    values, turns = state.values.copy(), state.camera_turns @ frame.turn
    across, by_frame = np.eye(len(values)), np.zeros((len(values), _POSE))
    by_scale = np.zeros(len(values))
    for block, before in zip(layout.cameras, state.camera_turns, strict=True):
        turn, place = slice(block.start, block.start + 3), slice(block.start + 3, block.start + 6)
        arm_m = state.values[place] - frame.origin_m
        values[place] = frame.turn.T @ arm_m
        across[place, place] = frame.turn.T
        by_frame[turn, :3] = before
        by_frame[place, :3] = frame.turn.T @ skew_matrices(arm_m)
        by_frame[place, 3:] = -frame.turn.T
        by_scale[place] = values[place] - middle_m
    across = across + by_frame @ frame.slopes
    covariance = across @ fit.covariance @ across.T + by_frame @ own @ by_frame.T
    covariance += scale_sigma**2 * np.outer(by_scale, by_scale)
    moved = replace(fit, covariance=covariance)
    state = replace(state, values=values, camera_turns=turns)
    moved = replace(moved, solution=replace(fit.solution, state=state))
    return _with_floor(moved, _reach_m(fit, frame))


def _reach_m(fit: JointFit, frame: LabFrame) -> Array:
    """Return the places over the floor that the body has visited, (n, 2) in m."""
    knots = fit.state.free_knots[:, :3]
    return np.asarray(((np.vstack([knots, fit.state.positions_m]) - frame.origin_m) @ frame.turn)[:, :2])


def _with_floor(fit: JointFit, places_m: Array) -> JointFit:
    """Return the fit with a floor of which only the usual unevenness is known."""
    layout, floor = fit.problem.layout, usual_floor(places_m, fit.settings)
    start = layout.modes.start
    kept = np.r_[0:start, start + floor.count : len(layout.mean) + floor.count - layout.floor.count]
    old = np.r_[0:start, layout.modes.stop : len(layout.mean)]
    size = len(old) + floor.count
    covariance, values = np.zeros((size, size)), np.zeros(size)
    covariance[np.ix_(kept, kept)] = fit.covariance[np.ix_(old, old)]
    modes = start + np.arange(floor.count)
    covariance[modes, modes] = 1.0
    values[kept] = fit.state.values[old]
    layout = replace(layout, floor=floor, mean=values, sigma=np.ones(size))
    state = replace(fit.state, values=values)
    return replace(
        fit,
        covariance=covariance,
        problem=replace(fit.problem, layout=layout),
        solution=replace(fit.solution, state=state),
    )
