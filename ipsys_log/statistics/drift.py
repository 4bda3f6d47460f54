"""Motion of a camera from the corners of reference markers, which are fixed to the floor or to a wall.

The motion has six unknowns: a turn and a shift. Near the optical axis, a turn by 0.1 degrees at a height of
2.1 m and a shift by 3.7 mm give the same image. So few markers determine the shift of the floor map well, and
the split into turn and shift badly. The prior standard deviation of both is the same length on the floor. Its
value is the one with the largest marginal likelihood (empirical Bayes): a camera that has not moved has a
prior near zero, so it has a small motion with a small uncertainty.

References
----------
Bishop, Pattern recognition and machine learning, 2006, sect. 3.5: the evidence approximation.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ipsys_log.calibration.joint.observations import lens_model_of
from ipsys_log.calibration.lens_models import project_points, project_with_slopes
from ipsys_log.messages import Array
from ipsys_log.statistics.floor_cameras import shift_floor_map
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import marker_corners, pixel_slopes
from ipsys_log.vision.poses import PosedCamera, rotation
from ipsys_log.vision.square_pose import fit_squares, is_convex

# A shift of the floor map below this mean is not reported: slow changes of light and temperature reach half
# of it, and the smallest motion to find is 2 mm.
LEAST_SHIFT_M = 0.0012
# Standard deviations of a corner: noise of a frame;
_FRAME_PX = 0.02
# slow changes of each corner;
_CORNER_PX = 0.03
# slow changes that all corners of a marker share, by light;
_MARKER_PX = 0.05
# and those that all markers of a camera share, by temperature.
_CAMERA_PX = 0.06
# Errors of the intrinsics and of the baseline poses change a displacement by this share.
_DISPLACEMENT_SHARE = 0.01
# Prior scales that are tried, in m on the floor. The least keeps the uncertainty of a still camera honest.
_SCALES_M = np.geomspace(2e-4, 1.0, 38)
# The prior of the estimate is wider than that of the largest evidence: it draws a motion less to zero.
_WIDER = 2.0
_LEAST_HEIGHT_M = 0.5
_STEPS = 5
# Step of numeric slopes, in rad and in m.
_SMALL = 1e-6
# Twice the gain of the logarithm of the evidence by a motion: 6 is strong, 10 is very strong (Kass and
# Raftery, Bayes factors, JASA 1995).
_SURE = 8.0
# Residuals of consistent markers exceed their expectation by less than this many standard deviations.
_CONSISTENT = 8.0
# Markers for the split into turn and shift (test_few_markers_do_not_separate_turn_and_shift),
_SPLIT_MARKERS = 3
# and their least spread: the second singular value of the directions to them.
_SPLIT_SPREAD = 0.15
_POSE_PX = 0.05
# The second pose of a marker is only taken if the corners clearly prefer it.
_OTHER_POSE_CHI2 = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class MeanCorners:
    """The mean corners (4, 2) of a marker over ``count`` frames, in px."""

    corners_px: Array
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class DriftBaseline:
    """The reference markers of a camera before a motion.

    Attributes
    ----------
    camera : the camera by its model.
    floor_m : (p, 3), points on the floor that the camera sees.
    corners : mean corners by marker id.
    points_c : by marker id, the corners (4, 3) in camera coordinates, in m.
    """

    camera: PosedCamera
    floor_m: Array
    corners: Mapping[int, MeanCorners]
    points_c: Mapping[int, Array]


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The motion of a camera since a baseline.

    Attributes
    ----------
    motion, covariance : (6,) and (6, 6), turn about the camera's axes in rad, and shift in the world in m.
    mean_shift_m, sigma_m : mean length of the shift of the floor map, and its standard deviation.
    markers : ids of the markers behind the estimate.
    inconsistent : ids of markers that contradict the others: they have moved themselves.
    is_unclear : two markers contradict each other, so either of them may have moved.
    evidence : twice the gain of the logarithm of the evidence by the motion.
    why_no_split : the reason why turn and shift are not known separately; None if they are.
    """

    motion: Array
    covariance: Array
    mean_shift_m: float
    sigma_m: float
    markers: tuple[int, ...]
    inconsistent: tuple[int, ...]
    is_unclear: bool
    evidence: float
    why_no_split: str | None

    @property
    def is_moved(self) -> bool:
        """Return whether the camera has certainly moved, by more than slow changes explain."""
        return self.mean_shift_m > LEAST_SHIFT_M and self.evidence > _SURE


def build_baseline(
    camera: PosedCamera, floor_m: Array, corners: Mapping[int, MeanCorners], lengths_m: Mapping[int, float]
) -> DriftBaseline:
    """Return the baseline of a camera; a marker outside of the field of view of its lens model is left out.

    Parameters
    ----------
    camera, floor_m : the camera, and the points of :func:`~ipsys_log.statistics.floor_cameras.floor_grid`.
    corners : mean corners by marker id.
    lengths_m : sides of the markers' black squares by id.
    """
    points_c = {}
    for marker_id, mean in sorted(corners.items()):
        uv = undistort(mean.corners_px, camera.lens)
        if not (np.isfinite(uv).all() and is_convex(uv)):
            continue
        whitening = np.zeros((1, 8, 8))
        for corner, slopes in enumerate(pixel_slopes(uv, camera.lens)):
            block = slice(2 * corner, 2 * corner + 2)
            whitening[0, block, block] = slopes / _POSE_PX
        length_m = lengths_m[marker_id]
        poses = fit_squares(uv[None], whitening, np.array([length_m]))
        other = int(poses.chi2[0, 1] < poses.chi2[0, 0] - _OTHER_POSE_CHI2)
        turn, centre_m = poses.rotations[0, other], poses.centres_m[0, other]
        points_c[marker_id] = marker_corners(length_m) @ turn.T + centre_m
    kept = {marker_id: corners[marker_id] for marker_id in points_c}
    return DriftBaseline(camera, floor_m, kept, points_c)


def estimate_motion(baseline: DriftBaseline, corners: Mapping[int, MeanCorners]) -> Motion | None:
    """Estimate the motion of a camera; None without a common marker.

    A marker that contradicts at least two others is left out.

    Parameters
    ----------
    baseline : the markers before the motion.
    corners : mean corners by marker id after it.
    """
    markers = sorted(set(baseline.corners) & set(corners))
    if not markers:
        return None
    fit = _fit(baseline, corners, markers)
    left_out: list[int] = []
    while not fit.is_consistent and len(markers) > 2:
        others = [_fit(baseline, corners, [m for m in markers if m != one]) for one in markers]
        best = min(range(len(others)), key=lambda n: others[n].chi2)
        left_out.append(markers.pop(best))
        fit = others[best]
    mean_m, sigma_m = _mean_shift(baseline, fit)
    return Motion(
        fit.motion,
        fit.covariance,
        mean_m,
        sigma_m,
        tuple(markers),
        tuple(sorted(left_out)),
        not fit.is_consistent,
        fit.evidence,
        _why_no_split(baseline, markers),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A motion with its covariance, the squared residuals ``chi2`` of ``rows`` coordinates, the evidence."""

    motion: Array
    covariance: Array
    chi2: float
    rows: int
    evidence: float

    @property
    def is_consistent(self) -> bool:
        return self.chi2 <= self.rows + _CONSISTENT * float(np.sqrt(2 * self.rows))


def _fit(baseline: DriftBaseline, corners: Mapping[int, MeanCorners], markers: list[int]) -> _Fit:
    """Fit a motion to the displacements of markers: Gauss-Newton with the prior of largest evidence."""
    moved_px = np.concatenate([corners[m].corners_px - baseline.corners[m].corners_px for m in markers])
    spread = np.linalg.cholesky(_covariance(baseline, corners, markers, moved_px))
    points_c = np.concatenate([baseline.points_c[m] for m in markers])
    height_m = max(abs(float(baseline.camera.origin_m[2])), _LEAST_HEIGHT_M)
    units = np.array([1 / height_m] * 3 + [1.0] * 3)
    camera = baseline.camera
    before_px = project_points(lens_model_of(camera.lens), _lens_parameters(camera), points_c)
    motion, scale_m = np.zeros(6), 1.0
    for _ in range(_STEPS):
        predicted_px, slopes = _displace(camera, points_c, motion)
        left = (moved_px - predicted_px + before_px).reshape(-1) + slopes @ motion
        rows, aims = np.linalg.solve(spread, slopes) * units, np.linalg.solve(spread, left)
        scale_m, evidence = _best_scale(rows, aims)
        inner = np.linalg.inv(rows.T @ rows + np.eye(6) / (_WIDER * scale_m) ** 2)
        motion = units * (inner @ (rows.T @ aims))
    residuals = aims - rows @ (motion / units)
    covariance = units[:, None] * inner * units
    return _Fit(motion, covariance, float(residuals @ residuals), len(aims), evidence)


def _covariance(
    baseline: DriftBaseline, corners: Mapping[int, MeanCorners], markers: list[int], moved_px: Array
) -> Array:
    """Return the covariance (8 k, 8 k) of the displacements of k markers, in px^2."""
    shared = np.tile(np.eye(2), (4, 4))
    covariance = 2 * _CAMERA_PX**2 * np.tile(shared, (len(markers), len(markers)))
    for n, marker_id in enumerate(markers):
        counts = baseline.corners[marker_id].count, corners[marker_id].count
        own_px2 = _FRAME_PX**2 * sum(1 / count for count in counts) + 2 * _CORNER_PX**2
        model_px2 = _DISPLACEMENT_SHARE**2 * float((moved_px[4 * n : 4 * n + 4] ** 2).mean())
        block = slice(8 * n, 8 * n + 8)
        covariance[block, block] += (own_px2 + model_px2) * np.eye(8) + 2 * _MARKER_PX**2 * shared
    return covariance


def _lens_parameters(camera: PosedCamera) -> Array:
    K = camera.lens.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera.lens.D])


def _displace(camera: PosedCamera, points_c: Array, motion: Array) -> tuple[Array, Array]:
    """Return the pixels (n, 2) of points (n, 3) after a motion, and their slopes (2 n, 6) by it."""
    turn = rotation(motion[:3])
    arrived_c = (points_c - camera.camera_from_world @ motion[3:]) @ turn.T
    model = lens_model_of(camera.lens)
    pixels, by_point, _ = project_with_slopes(model, _lens_parameters(camera), arrived_c)
    slopes = np.empty((len(points_c), 2, 6))
    # A small further turn w moves a point by w x p: its slope is p x (slope by the point).
    slopes[..., :3] = np.cross(arrived_c[:, None], by_point)
    slopes[..., 3:] = -by_point @ turn @ camera.camera_from_world
    return pixels, slopes.reshape(-1, 6)


def _best_scale(rows: Array, aims: Array) -> tuple[float, float]:
    """Return the prior scale with the largest evidence, and twice its logarithm against no motion."""
    left, sizes, _ = np.linalg.svd(rows, full_matrices=False)
    squares = (left.T @ aims) ** 2
    gains = 1 + np.outer(_SCALES_M**2, sizes**2)
    doubled = (squares * (1 - 1 / gains)).sum(axis=1) - np.log(gains).sum(axis=1)
    best = int(doubled.argmax())
    return float(_SCALES_M[best]), float(doubled[best])


def _mean_shift(baseline: DriftBaseline, fit: _Fit) -> tuple[float, float]:
    """Return the mean length of the shift of the floor map and its standard deviation, in m.

    Without a motion, the length has no slope: then the standard deviation is that of an axis of the mean.
    """
    shifts_m = shift_floor_map(baseline.camera, baseline.floor_m, fit.motion)
    slopes = np.stack(
        [
            (shift_floor_map(baseline.camera, baseline.floor_m, fit.motion + step) - shifts_m) / _SMALL
            for step in _SMALL * np.eye(6)
        ],
        axis=-1,
    )
    lengths_m = np.linalg.norm(shifts_m, axis=1)
    along = shifts_m / np.maximum(lengths_m, 1e-12)[:, None]
    by_length = np.einsum("pi,pij->j", along, slopes) / len(along)
    by_axis = slopes.mean(axis=0)
    of_length = float(by_length @ fit.covariance @ by_length)
    of_axis = float(np.trace(by_axis @ fit.covariance @ by_axis.T)) / 2
    return float(lengths_m.mean()), float(np.sqrt(max(of_length, of_axis)))


def _why_no_split(baseline: DriftBaseline, markers: list[int]) -> str | None:
    if len(markers) < _SPLIT_MARKERS:
        return (
            f"turn and shift cannot be separated with {len(markers)} reference "
            f"marker{'' if len(markers) == 1 else 's'}; fix {_SPLIT_MARKERS} or more in its field of view"
        )
    centres = np.array([baseline.points_c[m].mean(axis=0) for m in markers])
    directions = centres[:, :2] / centres[:, 2:]
    spread = np.linalg.svd(directions - directions.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(markers))
    if spread < _SPLIT_SPREAD:
        return (
            "turn and shift cannot be separated: its reference markers are near one line in the image; fix "
            "one beside the line"
        )
    return None
