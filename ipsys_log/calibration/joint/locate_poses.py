"""Full poses of markers from their corners, by a joint model, if heights are unknown or tops are tilted."""

from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.calibration.joint.locate import edge_motion, linearise_corners, marker_arms
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages import Array
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import pixel_slopes
from ipsys_log.vision.poses import rotate
from ipsys_log.vision.square_pose import fit_squares, tilt_cost

_STEPS = 2
# Relative error of the printed side of one marker beside the mean of all, which the model has.
_PRINT_SIGMA = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of n markers in the world.

    Attributes
    ----------
    points_m, turns : (n, 3) and (n, 3, 3), centres and axes; NaN for corners that the lens cannot reach.
    covariances_m2 : (n, 3, 3), of the points: noise, calibration and print.
    chi2 : (n,), squared residuals in units of the noise, with two degrees of freedom.
    modes_m : (n, 3, m), errors of the points by the modes of the calibration.
    noise_m2 : (n, 3, 3), the part of the covariances by the noise of the corners.
    heading_noise_rad : (n,), standard deviation of the headings by the same noise.
    """

    points_m: Array
    turns: Array
    covariances_m2: Array
    chi2: Array
    modes_m: Array
    noise_m2: Array
    heading_noise_rad: Array

    @property
    def headings_rad(self) -> Array:
        """The headings (n,), as ``Position.heading_rad``."""
        return np.asarray(np.arctan2(self.turns[:, 1, 1], self.turns[:, 0, 1]))


def locate_poses(model: JointModel, corners_px: Array, covariances_px2: Array, lengths_m: Array) -> Poses:
    """Return the poses of markers of any height and tilt.

    Parameters
    ----------
    model : the calibrated camera.
    corners_px : (n, 4, 2), in px of the raw image, in OpenCV's order.
    covariances_px2 : (n, 8, 8), of x0 y0 .. x3 y3.
    lengths_m : (n,), nominal sides of the markers.
    """
    inward, sizes_m = edge_motion(corners_px), lengths_m * model.scale
    variances = covariances_px2 + model.corner_floor_px**2 * np.eye(8)
    points_m, turns = _start(model, corners_px - model.edge_offset_px * inward, variances, sizes_m)
    weights = np.linalg.inv(variances)
    for _ in range(_STEPS):
        now = linearise_corners(model, corners_px, inward, points_m, marker_arms(turns, sizes_m))
        across = now.by_pose.swapaxes(1, 2) @ weights
        spread = np.linalg.inv(across @ now.by_pose)
        gains = spread @ across
        change = (gains @ now.residuals[:, :, None])[:, :, 0]
        points_m, turns = points_m - change[:, :3], rotate(-change[:, 3:]) @ turns
    left = now.residuals[:, :, None] - now.by_pose @ change[:, :, None]
    modes_m = -(gains[:, :3] @ now.by_camera) @ model.modes
    noise_m2 = np.asarray(spread[:, :3, :3], dtype=np.float64)
    heading_noise_rad: Array = np.sqrt(spread[:, 5, 5])
    # Another size of the marker scales its point about the camera.
    by_print_m = _PRINT_SIGMA * (points_m - model.origin_m)[:, :, None]
    return Poses(
        points_m,
        turns,
        noise_m2 + modes_m @ modes_m.swapaxes(1, 2) + by_print_m @ by_print_m.swapaxes(1, 2),
        (left.swapaxes(1, 2) @ weights @ left)[:, 0, 0],
        modes_m,
        noise_m2,
        heading_noise_rad,
    )


def hold_heights(
    model: JointModel, poses: Poses, heights_m: Array, sigmas_m: Array
) -> tuple[Poses, Array, Array]:
    """Return poses whose points also use known heights above the floor, and the heights without them.

    The second result (n,) are the heights above the floor by the corners alone, the third (n,) the standard
    deviations of their differences to the known heights.

    Parameters
    ----------
    poses : poses by :func:`locate_poses`.
    heights_m, sigmas_m : (n,), the known heights, and their standard deviations.
    """
    floor_m, slopes, floor_modes = model.floor.evaluate(np.nan_to_num(poses.points_m), model.amplitudes)
    rise = np.concatenate([-slopes, np.ones((len(slopes), 1))], axis=1)[:, None]
    # The error of the floor, and that of the height above it.
    by_floor_m = np.zeros((len(slopes), 1, model.modes.shape[1]))
    by_floor_m[:, 0, : model.floor_modes.shape[1]] = floor_modes @ model.floor_modes
    misses_m2 = (by_floor_m**2).sum(axis=2)[:, 0] + sigmas_m**2
    above_m = poses.points_m[:, 2] - floor_m
    variances_m2 = (rise @ poses.covariances_m2 @ rise.swapaxes(1, 2))[:, 0, 0] + misses_m2
    gains = poses.covariances_m2 @ rise.swapaxes(1, 2) / variances_m2[:, None, None]
    kept = np.eye(3) - gains @ rise

    def reduced(covariances_m2: Array, height_m2: Array) -> Array:
        known = gains @ gains.swapaxes(1, 2) * height_m2[:, None, None]
        return np.asarray(kept @ covariances_m2 @ kept.swapaxes(1, 2) + known)

    held = replace(
        poses,
        points_m=poses.points_m + gains[:, :, 0] * (heights_m - above_m)[:, None],
        covariances_m2=reduced(poses.covariances_m2, misses_m2),
        modes_m=kept @ poses.modes_m + gains @ by_floor_m,
        noise_m2=reduced(poses.noise_m2, np.zeros(len(slopes))),
    )
    return held, above_m, np.sqrt(variances_m2)


def _start(model: JointModel, corners_px: Array, variances: Array, sizes_m: Array) -> tuple[Array, Array]:
    """Return points (n, 3) and axes (n, 3, 3) in the world, from the two solutions for a square."""
    count, lens = len(corners_px), model.calibration
    uv = undistort(corners_px.reshape(-1, 2), lens)
    valid = np.isfinite(uv.reshape(count, 8)).all(axis=1)
    points_m, turns = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    if not valid.any():
        return points_m, turns
    own = uv.reshape(count, 4, 2)[valid]
    whitening = np.linalg.inv(np.linalg.cholesky(variances[valid])).reshape(-1, 8, 4, 2)
    slopes = pixel_slopes(own.reshape(-1, 2), lens).reshape(-1, 4, 2, 2)
    by_uv = np.einsum("nrci,ncij->nrcj", whitening, slopes).reshape(-1, 8, 8)
    poses = fit_squares(own, by_uv, sizes_m[valid])
    world = model.camera_from_world.T @ poses.rotations
    best = (poses.chi2 + tilt_cost(world[..., 2, 2])).argmin(axis=1)
    rows = np.arange(len(best))
    points_m[valid] = poses.centres_m[rows, best] @ model.camera_from_world + model.origin_m
    turns[valid] = world[rows, best]
    return points_m, turns
