"""Full poses of rigid bodies from the corners of all their markers in one frame, by a joint model."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.locate import edge_motion, linearise_corners
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.lens_models import project_points
from ipsys_log.messages import Array, Mask
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import pixel_slopes
from ipsys_log.vision.poses import cross, rotate, rotation_vectors, skew_matrices
from ipsys_log.vision.square_pose import fit_squares

# A body is tilted by this standard deviation about each axis: it tells mirrored poses of one marker apart.
_TILT_RAD = np.radians(20.0)
# The usual velocity (m/s) and angular velocity (rad/s) of a body, along and about each axis.
TWIST_SIGMAS = np.repeat([0.5, 1.5], 3)
# Two solutions that differ by less than this converge to the same pose.
_SAME_RAD = 0.02
_STEPS = 4
_DAMPING = 1e-3
# The refinement ends when a step promises less than this share of chi2, or than this.
_SETTLED, _EXACT = 1e-2, 1e-6
_AXES = np.arange(6)


class BodySightings(NamedTuple):
    """The sightings of b bodies with k markers each in one frame.

    Attributes
    ----------
    corners_px : (b, k, 4, 2), in px of the raw image, in OpenCV's order.
    covariances_px2 : (b, k, 8, 8), of x0 y0 .. x3 y3.
    corners_m : (b, k, 4, 3), the corners in the coordinates of the bodies.
    times_s : (b, k, 4), exposures of the rows of the corners, from the instant of the pose.
    at_one_instant : detection knew the row time: the corners of a marker are those at their mean time, except
        for its motion out of its plane.
    """

    corners_px: Array
    covariances_px2: Array
    corners_m: Array
    times_s: Array
    at_one_instant: bool


@dataclass(frozen=True, slots=True, eq=False)
class BodyPoses:
    """Poses of b bodies in the world; NaN for bodies that the model cannot see.

    Attributes
    ----------
    points_m, turns : (b, 3) and (b, 3, 3), origins and axes.
    spread : (b, 6, 6), covariances of the points and of turns about the axes of the world, by the noise of
        the corners and by a usual velocity: a rolling shutter shows a moving body elsewhere.
    to_still : (b, 6), from these poses to those of bodies that stand still: motion, and turn. A filter that
        knows the velocity uses the latter.
    noise : (b, 6, 6), covariances of the poses of bodies that stand still.
    by_twist : (b, 6, 6), errors of these poses by the velocity (m/s) and the angular velocity (rad/s) along
        and about the axes of the world.
    modes : (b, 6, m), errors of these poses by the modes of the calibration.
    by_scale : (b, 6), errors of these poses by the relative error of the size of the body.
    chi2, still_chi2 : (b,), squared residuals of both poses, with 8 k - 6 degrees of freedom: in units of the
        noise and of a usual velocity, and of the noise alone.
    """

    points_m: Array
    turns: Array
    spread: Array
    to_still: Array
    noise: Array
    by_twist: Array
    modes: Array
    by_scale: Array
    chi2: Array
    still_chi2: Array


def locate_bodies(model: JointModel, seen: BodySightings) -> BodyPoses:
    """Return the poses of bodies by weighted least squares over all corners.

    Each marker has two poses, and so each body has two candidates for each marker. The two best candidates
    with different rotations are refined. The better one has the smaller sum of squared residuals and of the
    squared tilt in units of 20 degrees.

    Parameters
    ----------
    model : the calibrated camera.
    seen : the sightings of b bodies, each with the same number of markers.
    """
    points_m, turns = body_candidates(model, seen)
    rounds, row = _Rounds(model, seen, points_m[:, :1], turns[:, :1]), np.arange(len(points_m))
    costs = rounds.look(points_m, turns).chi2 + _tilt_cost(turns)
    first = costs.argmin(axis=1)
    apart = angles_between(turns, turns[row, first][:, None])
    second = np.where(apart < _SAME_RAD, np.inf, costs).argmin(axis=1)
    two = np.stack([first, second], axis=1)
    now = rounds.refine(points_m[row[:, None], two], turns[row[:, None], two])
    best = (now.chi2 + _tilt_cost(now.turns)).argmin(axis=1)
    return rounds.finish(now.points_m[row, best], now.turns[row, best])


class _Look(NamedTuple):
    """Candidates (b, c, 3), (b, c, 3, 3), their residuals (b, c, 8 k), slopes and chi2 (b, c).

    ``by_pose`` (b, c, 8 k, 6) and ``by_camera`` (b, c, 8 k, q + 10) are slopes by the pose and by the camera.
    """

    points_m: Array
    turns: Array
    residuals: Array
    by_pose: Array
    by_camera: Array
    chi2: Array


class _Rounds:
    """The rounds of least squares for the same sightings.

    The rows of the corners have different exposures. The unknown velocity of the body makes their errors
    dependent: the weights take this from rough poses (b, 1, 3), (b, 1, 3, 3).
    """

    def __init__(self, model: JointModel, seen: BodySightings, points_m: Array, turns: Array) -> None:
        self._model, self._seen = model, seen
        count, markers = seen.corners_px.shape[:2]
        self._inward = edge_motion(seen.corners_px.reshape(-1, 4, 2)).reshape(count, 1, markers, 4, 2)
        variances = np.zeros((count, markers, 8, markers, 8))
        number = np.arange(markers)
        own = seen.covariances_px2 + model.corner_floor_px**2 * np.eye(8)
        variances[:, number, :, number] = own.swapaxes(0, 1)
        self._variances = variances.reshape(count, 1, markers * 8, markers * 8)
        self._weights = np.zeros_like(self._variances)
        usual = self._by_twist(self.look(points_m, turns)) * TWIST_SIGMAS
        spread = self._variances + usual @ usual.swapaxes(-1, -2)
        self._weights = np.asarray(np.linalg.inv(spread), dtype=np.float64)

    def look(self, points_m: Array, turns: Array) -> _Look:
        """Return the residuals and slopes of candidates (b, c, 3), (b, c, 3, 3)."""
        count, candidates = points_m.shape[:2]
        markers = self._seen.corners_px.shape[1]
        many = count, candidates, markers
        arms_m = self._seen.corners_m[:, None] @ turns[:, :, None].swapaxes(-1, -2)
        now = linearise_corners(
            self._model,
            np.broadcast_to(self._seen.corners_px[:, None], (*many, 4, 2)).reshape(-1, 4, 2),
            np.broadcast_to(self._inward, (*many, 4, 2)).reshape(-1, 4, 2),
            np.broadcast_to(points_m[:, :, None], (*many, 3)).reshape(-1, 3),
            arms_m.reshape(-1, 4, 3),
        )
        residuals, by_pose, by_camera = (
            part.reshape(count, candidates, markers * 8, *part.shape[2:]) for part in now
        )
        chi2 = (residuals * (self._weights @ residuals[..., None])[..., 0]).sum(axis=-1)
        return _Look(points_m, turns, residuals, by_pose, by_camera, chi2)

    def _by_twist(self, now: _Look) -> Array:
        """Return the slopes (b, c, 8 k, 6) of the corners by the twist of the body."""
        arms_m = self._seen.corners_m[:, None] @ now.turns[:, :, None].swapaxes(-1, -2)
        by_corner = now.by_pose[..., :3].reshape(*arms_m.shape[:-1], 2, 3)
        times_s = self._seen.times_s[:, None]
        motion = corner_motion(arms_m, times_s, at_one_instant=self._seen.at_one_instant)
        return np.asarray((by_corner @ motion).reshape(now.by_pose.shape))

    def refine(self, points_m: Array, turns: Array) -> _Look:
        """Return candidates after Levenberg-Marquardt steps."""
        now = self.look(points_m, turns)
        damping = np.full(now.chi2.shape, _DAMPING)
        for _ in range(_STEPS):
            across = now.by_pose.swapaxes(-1, -2) @ self._weights
            normal, gradient = across @ now.by_pose, across @ now.residuals[..., None]
            normal[..., _AXES, _AXES] *= 1 + damping[..., None]
            step = np.asarray(np.linalg.solve(normal, gradient), dtype=np.float64)
            expected = (step * gradient).sum(axis=(-1, -2))
            turned = rotate(-step[..., 3:, 0].reshape(-1, 3)).reshape(turns.shape) @ now.turns
            tried = self.look(now.points_m - step[..., :3, 0], turned)
            better = tried.chi2 <= now.chi2
            now = tried if better.all() else _choose(better, tried, now)
            if (expected <= _SETTLED * now.chi2 + _EXACT).all():
                break
            damping = np.where(better, damping / 100, 100 * damping)
        return now

    def finish(self, points_m: Array, turns: Array) -> BodyPoses:
        """Return the poses (b, 3), (b, 3, 3) after one more step, with their uncertainties."""
        looked = self.look(points_m[:, None], turns[:, None])
        by_twist, now = self._by_twist(looked)[:, 0], _Look(*(part[:, 0] for part in looked))
        usual, variances = by_twist * TWIST_SIGMAS, self._variances[:, 0]
        moving, spread, _ = _step(now, variances + usual @ usual.swapaxes(1, 2))
        still, noise, gains = _step(now, variances)
        turned, standing = (rotate(-change[:, 3:]) @ turns for change in (moving, still))
        to_still = rotation_vectors(standing @ turned.swapaxes(1, 2))
        by_camera = -(gains @ now.by_camera)
        left = now.residuals - (now.by_pose @ still[:, :, None])[:, :, 0]
        weighed = np.linalg.solve(variances, left[:, :, None])[:, :, 0]
        return BodyPoses(
            points_m - moving[:, :3],
            turned,
            spread,
            np.concatenate([moving[:, :3] - still[:, :3], to_still], axis=1),
            noise,
            gains @ by_twist,
            by_camera @ self._model.modes,
            by_camera[:, :, -1] * self._model.scale,
            now.chi2,
            (left * weighed).sum(axis=1),
        )


def corner_motion(arms_m: Array, times_s: Array, at_one_instant: bool) -> Array:
    """Return the motion of corners (..., 4, 3, 6) by the twist of their body, until their exposures.

    ``arms_m`` (..., 4, 3) are the vectors from the origin of the body to the corners of markers. For
    ``times_s`` (..., 4) and ``at_one_instant``, see :class:`BodySightings`.
    """
    times_s = times_s[..., None, None]
    moved = np.concatenate([np.broadcast_to(np.eye(3), (*arms_m.shape, 3)), -skew_matrices(arms_m)], axis=-1)
    if not at_one_instant:
        return np.asarray(times_s * moved)
    # The motion at the mean time of the marker, and that out of its plane from there to the row.
    middle_m = arms_m.mean(axis=-2, keepdims=True)
    normal = cross(arms_m[..., 1, :] - arms_m[..., 0, :], arms_m[..., 0, :] - arms_m[..., 3, :])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    out = normal[..., None, :, None] * normal[..., None, None, :]
    tilt = -skew_matrices(arms_m - middle_m) @ (np.eye(3) - out)
    along = np.broadcast_to(out, tilt.shape)
    out_of_plane = np.concatenate([along, -out @ skew_matrices(middle_m) + tilt], axis=-1)
    middle_s = times_s.mean(axis=-3, keepdims=True)
    return np.asarray(middle_s * moved + (times_s - middle_s) * out_of_plane)


def _step(now: _Look, variances: Array) -> tuple[Array, Array, Array]:
    """Return changes (b, 6), covariances and gains (b, 6, 8 k), by variances (b, 8 k, 8 k) of the corners."""
    across = now.by_pose.swapaxes(1, 2) @ np.linalg.inv(variances)
    covariances = np.asarray(np.linalg.inv(across @ now.by_pose), dtype=np.float64)
    gains = covariances @ across
    return (gains @ now.residuals[:, :, None])[:, :, 0], covariances, gains


def _choose(better: Mask, tried: _Look, now: _Look) -> _Look:
    def pick(new: Array, old: Array) -> Array:
        return np.where(better.reshape(*better.shape, *[1] * (new.ndim - 2)), new, old)

    return _Look(*(pick(new, old) for new, old in zip(tried, now, strict=True)))


def body_candidates(model: JointModel, seen: BodySightings) -> tuple[Array, Array]:
    """Return the poses (b, 2 k, 3), (b, 2 k, 3, 3) of bodies by both poses of each of their markers."""
    count, markers = seen.corners_px.shape[:2]
    corners_px = seen.corners_px.reshape(-1, 4, 2)
    corners_px = corners_px - model.edge_offset_px * edge_motion(corners_px)
    uv = undistort(corners_px.reshape(-1, 2), model.calibration)
    uv = np.where(np.isfinite(uv), uv, 0.0).reshape(-1, 4, 2)
    variances = seen.covariances_px2.reshape(-1, 8, 8) + model.corner_floor_px**2 * np.eye(8)
    whitening = np.linalg.inv(np.linalg.cholesky(variances)).reshape(-1, 8, 4, 2)
    slopes = pixel_slopes(uv.reshape(-1, 2), model.calibration).reshape(-1, 4, 2, 2)
    by_uv = np.einsum("nrci,ncij->nrcj", whitening, slopes).reshape(-1, 8, 8)
    corners_m = seen.corners_m.reshape(-1, 4, 3)
    right, up = corners_m[:, 1] - corners_m[:, 0], corners_m[:, 0] - corners_m[:, 3]
    sides_m = np.linalg.norm(right, axis=1)
    axes = np.stack([right, up, np.cross(right, up) / sides_m[:, None]], axis=2) / sides_m[:, None, None]
    poses = fit_squares(uv, by_uv, sides_m)
    turns = model.camera_from_world.T @ poses.rotations @ axes.swapaxes(1, 2)[:, None]
    centres_m = poses.centres_m @ model.camera_from_world + model.origin_m
    points_m = centres_m - (turns @ corners_m.mean(axis=1)[:, None, :, None])[..., 0]
    return points_m.reshape(count, 2 * markers, 3), turns.reshape(count, 2 * markers, 3, 3)


def _tilt_cost(turns: Array) -> Array:
    """Return -2 log of the prior probability (b, c) of rotations (b, c, 3, 3)."""
    # 2 (1 - cosine) is the square of the angle, if the angle is small.
    return np.asarray(2 * (1 - turns[..., 2, 2]) / _TILT_RAD**2)


def angles_between(first: Array, second: Array) -> Array:
    """Return the angles (...) between rotations (..., 3, 3)."""
    traces = (first * second).sum(axis=(-1, -2))
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0)))


# A grid of bodies in the view of a camera: shares of its principal point, and of its height.
_VIEW_SHARES, _DEPTH_SHARES = np.linspace(0.15, 1.85, 6), (0.4, 0.7, 1.0)
# A turn of 1 rad counts like a motion of this length.
_ARM_M = 0.3


def strongest_modes(models: Iterable[JointModel], corners_m: Array, count: int) -> Array:
    """Return the combinations (m, count) of the modes of all cameras that change the poses of bodies most.

    The first modes are orthonormal; they are the same for all cameras.

    Parameters
    ----------
    models : the calibrated cameras.
    corners_m : (k, 4, 3), the corners of a usual body.
    count : the number of combinations.
    """
    effects = []
    for model in models:
        u, v = np.meshgrid(_VIEW_SHARES * model.lens[2], _VIEW_SHARES * model.lens[3])
        uv = undistort(np.stack([u.ravel(), v.ravel()], axis=1), model.calibration)
        rays = np.column_stack([uv, np.ones(len(uv))]) @ model.camera_from_world
        rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] < 0)]
        depths_m = -np.array(_DEPTH_SHARES)[:, None] * model.origin_m[2] / rays[:, 2]
        points_m = (model.origin_m + depths_m[:, :, None] * rays).reshape(-1, 3)
        level = np.broadcast_to(np.eye(3), (len(points_m), 3, 3))
        rounds = _Rounds(
            model, level_sightings(model, points_m, corners_m), points_m[:, None], level[:, None]
        )
        poses = rounds.finish(points_m, level)
        seen = np.isfinite(poses.modes).all(axis=(1, 2))
        effects.append(poses.modes[seen] * np.repeat([1.0, _ARM_M], 3)[:, None])
    rows = np.concatenate(effects).reshape(-1, effects[0].shape[2])
    _, axes = np.linalg.eigh(rows.T @ rows)
    return np.ascontiguousarray(axes[:, ::-1][:, :count])


def level_sightings(model: JointModel, points_m: Array, corners_m: Array) -> BodySightings:
    """Return the exact sightings of bodies (b, 3) whose axes are those of the world."""
    count, markers = len(points_m), len(corners_m)
    points_c = ((points_m[:, None, None] + corners_m) - model.origin_m) @ model.camera_from_world.T
    shape = count, markers, 4
    pixels = project_points(model.lens_model, model.lens, points_c.reshape(-1, 3)).reshape(*shape, 2)
    return BodySightings(
        pixels,
        np.broadcast_to(np.eye(8), (count, markers, 8, 8)),
        np.broadcast_to(corners_m, (*shape, 3)),
        np.zeros(shape),
        at_one_instant=True,
    )
