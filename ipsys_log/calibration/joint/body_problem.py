"""The least squares of a carried body: its poses in all frames, and the poses and sides of its markers."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.body_frames import LINKED_S, BodyFrame
from ipsys_log.calibration.joint.locate import corner_covariances, edge_motion, linearise_corners
from ipsys_log.calibration.joint.locate_bodies import (
    TWIST_SIGMAS,
    BodySightings,
    angles_between,
    body_candidates,
    corner_motion,
    locate_bodies,
)
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.robust import limit_of, robust_loss
from ipsys_log.messages import Array, Rig
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import marker_corners_m
from ipsys_log.vision.poses import cross, rotate, rotation_vectors

# Relative standard deviations of printed sides: of all prints of a printer, and of one print.
PRINT_SIGMA, SIDE_SIGMA = 0.002, 0.001
# Far above the usual ones: a prior that holds back a motion holds back the size of the body, which scales it.
_TWIST_SIGMAS = 10 * TWIST_SIGMAS
# The usual acceleration of a carried body between two frames, per axis.
_ACCELERATIONS = np.repeat([4.0, 20.0], 3)  # in m/s^2 and rad/s^2
# Poses by two calibrated cameras differ by about this much, in m and rad.
_CAMERAS_APART = np.repeat([0.001, 0.001], 3)
_ROUNDS, _DAMPING, _SETTLED = 40, 1e-4, 1e-9
# Median of chi2 with eight degrees of freedom.
_MEDIAN_CHI2 = 7.344
# Unknowns of a pose, of a frame, and of a marker: turn, centre and logarithm of the side.
_POSE, _TWIST, MARKER = 6, 12, 7


class BodyState(NamedTuple):
    """The unknowns: poses and twists (f, 6) of the body, poses and sides of its markers, scale of prints."""

    points_m: Array
    turns: Array
    twists: Array
    marker_turns: Array
    centres_m: Array
    log_sides: Array
    log_print: float


class _Block(NamedTuple):
    """Standardised residuals (n, r), their slopes (n, r, c) by the unknowns ``columns`` (n, c)."""

    residuals: Array
    columns: NDArray[np.int64]
    slopes: Array
    limit: float

    @property
    def chi2(self) -> Array:
        return np.asarray((self.residuals * self.residuals).sum(axis=1))

    @property
    def weights(self) -> Array:
        return robust_loss(self.chi2, self.limit)[1]


class BodyProblem:
    """The least squares of a body over its sightings: n sightings of k markers in f frames."""

    def __init__(
        self,
        cameras: Mapping[str, JointModel],
        rig: Rig,
        robot: str,
        ids: Sequence[int],
        frames: Sequence[BodyFrame],
    ) -> None:
        self.cameras, self.rig, self.robot, self.ids, self.frames = cameras, rig, robot, ids, frames
        self.lengths_m = np.array([rig.length_of(i) for i in ids])
        number = {i: n for n, i in enumerate(ids)}
        markers = [marker for frame in frames for marker in frame.markers]
        self.marker = np.array([number[marker.id] for marker in markers])
        self.frame = np.repeat(np.arange(len(frames)), [len(frame.markers) for frame in frames])
        self.corners_px = np.array([marker.corners_px for marker in markers], dtype=np.float64)
        self.inward = edge_motion(self.corners_px)
        names = np.array([frame.camera for frame in frames for _ in frame.markers])
        self.rows = {camera: np.flatnonzero(names == camera) for camera in np.unique(names).tolist()}
        times_s = [(t - frame.time_ns) / NS_PER_S for frame in frames for t in frame.times_ns]
        rows_px = self.corners_px[..., 1] - self.corners_px[..., 1].mean(axis=1, keepdims=True)
        known_s = {camera: (rig.camera(camera).row_time_ns or 0) / NS_PER_S for camera in cameras}
        self.at_one_instant = {camera: known_s[camera] > 0 for camera in cameras}
        floor_px, row_s = np.zeros((2, len(markers)))
        for camera, rows in self.rows.items():
            floor_px[rows] = cameras[camera].corner_floor_px
            row_s[rows] = known_s[camera] + cameras[camera].row_time_s
        self.times_s = np.array(times_s)[:, None] + rows_px * row_s[:, None]
        covariances_px2 = corner_covariances([marker.covariance_px2 for marker in markers])
        self.covariances_px2 = covariances_px2 + floor_px[:, None, None] ** 2 * np.eye(8)
        self.whitening = np.linalg.inv(np.linalg.cholesky(self.covariances_px2))
        first_ns = frames[0].time_ns
        self.frame_s = np.array([(frame.time_ns - first_ns) / NS_PER_S for frame in frames])
        self.linked = np.flatnonzero((np.diff(self.frame_s) < LINKED_S) & (np.diff(self.frame_s) > 0))
        self.shared = _TWIST * len(frames)
        width = self.shared + MARKER * len(ids) + 1
        # The pose of the first marker is that of the body.
        self.kept = np.delete(np.arange(width), self.shared + np.arange(_POSE))

    def solve(self) -> BodyState:
        """Return the unknowns; the noise of the corners grows to that of the residuals."""
        now = self._refine(self._start())
        # Bent prints and compressed images have larger errors than the noise of their corners.
        chi2 = self.sightings(now).chi2
        freedom = 1 - _POSE * len(self.frames) / (8 * len(chi2))
        noise = max(1.0, float(np.median(chi2)) / (_MEDIAN_CHI2 * max(freedom, 0.1)))
        self.whitening /= np.sqrt(noise)
        return self._refine(now)

    def _start(self) -> BodyState:
        """Return approximate unknowns, from both poses of each marker that are consistent over the frames."""
        poses = np.zeros((len(self.frame), 2, 4, 4))
        poses[..., 3, 3] = 1.0
        corners_m = np.array([marker_corners_m(length_m) for length_m in self.lengths_m])
        for camera, rows in self.rows.items():
            one = self._sightings_of(camera, rows[:, None], corners_m)
            poses[rows, :, :3, 3], poses[rows, :, :3, :3] = body_candidates(self.cameras[camera], one)
        markers = self._start_markers(poses)
        corners_m = corners_m @ markers[:, :3, :3].swapaxes(1, 2) + markers[:, None, :3, 3]
        points_m, turns = np.zeros((len(self.frames), 3)), np.zeros((len(self.frames), 3, 3))
        counts = np.bincount(self.frame)[self.frame]
        for camera, rows in self.rows.items():
            for count in np.unique(counts[rows]):
                group = rows[counts[rows] == count].reshape(-1, count)
                sightings = self._sightings_of(camera, group, corners_m)
                found = locate_bodies(self.cameras[camera], sightings)
                points_m[self.frame[group[:, 0]]] = found.points_m
                turns[self.frame[group[:, 0]]] = found.turns
        twists, sides = np.zeros((len(self.frames), 6)), np.log(self.lengths_m)
        return BodyState(points_m, turns, twists, markers[:, :3, :3], markers[:, :3, 3], sides, 0.0)

    def _sightings_of(self, camera: str, rows: NDArray[np.int64], corners_m: Array) -> BodySightings:
        return BodySightings(
            self.corners_px[rows],
            self.covariances_px2[rows],
            corners_m[self.marker[rows]],
            self.times_s[rows],
            self.at_one_instant[camera],
        )

    def _start_markers(self, poses: Array) -> Array:
        """Return the poses (k, 4, 4) of the markers relative to the first one, along the pairs seen most."""
        by_frame = np.full((len(self.frames), len(self.ids)), -1)
        by_frame[self.frame, self.marker] = np.arange(len(self.frame))
        seen = (by_frame >= 0).astype(int)
        together = seen.T @ seen
        placed = {0: np.eye(4)}
        while len(placed) < len(self.ids):
            rest = [n for n in range(len(self.ids)) if n not in placed]
            a, b = max(((a, b) for a in placed for b in rest), key=lambda pair: together[pair])
            rows = by_frame[(by_frame[:, a] >= 0) & (by_frame[:, b] >= 0)]
            first, second = poses[rows[:, a]], poses[rows[:, b]]
            both = np.linalg.inv(first)[:, :, None] @ second[:, None]
            placed[b] = placed[a] @ _most_consistent(both.reshape(len(rows), 4, 4, 4), self.lengths_m[a])
        return np.array([placed[n] for n in range(len(self.ids))])

    def sightings(self, now: BodyState, by_mode: Array | None = None) -> _Block:
        """Return the residuals of the corners; ``by_mode`` (n, 8, m) gets those by the modes."""
        count = len(self.frame)
        residuals, slopes = np.zeros((count, 8)), np.zeros((count, 8, _TWIST + MARKER))
        own_m = np.array([marker_corners_m(1.0)] * count) * np.exp(now.log_sides)[self.marker, None, None]
        own_m = own_m @ now.marker_turns[self.marker].swapaxes(1, 2)
        turns = now.turns[self.frame]
        arms_m = (own_m + now.centres_m[self.marker][:, None]) @ turns.swapaxes(1, 2)
        own_m = own_m @ turns.swapaxes(1, 2)
        for camera, rows in self.rows.items():
            model = self.cameras[camera]
            motion = corner_motion(arms_m[rows], self.times_s[rows], self.at_one_instant[camera])
            twists = now.twists[self.frame[rows]]
            moved_m = arms_m[rows] + (motion @ twists[:, None, :, None])[..., 0]
            points_m = now.points_m[self.frame[rows]]
            seen = linearise_corners(model, self.corners_px[rows], self.inward[rows], points_m, moved_m)
            by_point = seen.by_pose[..., :3].reshape(-1, 4, 2, 3)
            by_turn = cross(own_m[rows][:, :, None], by_point)  # in world axes
            columns = (
                by_point,
                cross(arms_m[rows][:, :, None], by_point),
                by_point @ motion,
                by_turn @ turns[rows][:, None],
                by_point @ turns[rows][:, None],
                (by_point * own_m[rows][:, :, None]).sum(axis=-1, keepdims=True),
            )
            slopes[rows] = np.concatenate(columns, axis=-1).reshape(len(rows), 8, -1)
            residuals[rows] = seen.residuals
            if by_mode is not None:
                clock = len(model.lens) + 7
                seen.by_camera[..., clock] = (slopes[rows, :, :_POSE] @ twists[:, :, None])[..., 0]
                # The sides of this body are unknowns of their own.
                by_mode[rows] = self.whitening[rows] @ (seen.by_camera[..., :-1] @ model.modes[:-1])
        of_frame = _TWIST * self.frame[:, None] + np.arange(_TWIST)
        of_marker = self.shared + MARKER * self.marker[:, None] + np.arange(MARKER)
        residuals = (self.whitening @ residuals[..., None])[..., 0]
        return _Block(
            residuals, np.hstack([of_frame, of_marker]), self.whitening @ slopes, float(limit_of(8.0))
        )

    def _priors(self, now: BodyState) -> Iterator[_Block]:
        """Yield the residuals of the motion and of the prints."""
        frames, last = len(self.frames), self.kept[-1:]
        columns = np.arange(0, self.shared, _TWIST)[:, None] + np.arange(_POSE, _TWIST)
        slopes = np.tile(np.diag(1 / _TWIST_SIGMAS), (frames, 1, 1))
        yield _Block(now.twists / _TWIST_SIGMAS, columns, slopes, np.inf)
        odd = (now.log_sides - np.log(self.lengths_m) - now.log_print) / SIDE_SIGMA
        columns = np.column_stack(np.broadcast_arrays(np.arange(self.shared + _POSE, last[0], MARKER), last))
        slopes = np.tile([1.0, -1.0], (len(odd), 1, 1)) / SIDE_SIGMA
        limit = float(limit_of(1.0))
        yield _Block(odd[:, None], columns, slopes, limit)
        slopes = np.full((1, 1, 1), 1 / PRINT_SIGMA)
        yield _Block(slopes[0] * now.log_print, last[:, None], slopes, limit)
        if len(self.linked):
            yield self._links(now)

    def _links(self, now: BodyState) -> _Block:
        """Return the residuals of successive poses and twists, by the acceleration between them."""
        before, after = self.linked, self.linked + 1
        gap_s = (self.frame_s[after] - self.frame_s[before])[:, None]
        turned = rotation_vectors(now.turns[after] @ now.turns[before].swapaxes(1, 2))
        moved = np.hstack([now.points_m[after] - now.points_m[before], turned])
        residuals = np.hstack([moved - gap_s * now.twists[before], now.twists[after] - now.twists[before]])
        gap_s = gap_s[:, :, None]
        one, none = np.eye(6) * np.ones_like(gap_s), np.zeros((len(gap_s), 6, 6))
        slopes = np.block([[-one, -gap_s * one, one, none], [none, -one, none, one]])
        noise = gap_s**2 * np.diag(_ACCELERATIONS**2)
        apart = gap_s**2 / 3 * noise + np.diag(_CAMERAS_APART**2)
        covariances = np.block([[apart, gap_s / 2 * noise], [gap_s / 2 * noise, noise]])
        whitening = np.linalg.inv(np.linalg.cholesky(covariances))
        columns = _TWIST * before[:, None] + np.arange(2 * _TWIST)
        residuals = (whitening @ residuals[..., None])[..., 0]
        return _Block(residuals, columns, whitening @ slopes, np.inf)

    def _refine(self, now: BodyState) -> BodyState:
        """Return the unknowns after steps of Levenberg and Marquardt."""
        from scipy.sparse import diags

        blocks = [self.sightings(now), *self._priors(now)]
        cost, damping = _cost(blocks), _DAMPING
        normal, gradient = self._normal(blocks)
        for _ in range(_ROUNDS):
            step = _solve(normal + diags(damping * normal.diagonal()), -gradient)
            expected = -float(step @ gradient)
            tried = self._move(now, step)
            blocks = [self.sightings(tried), *self._priors(tried)]
            new = _cost(blocks)
            if new <= cost:
                now, cost, damping = tried, new, damping / 10
                normal, gradient = self._normal(blocks)
            else:
                damping *= 10
            if expected <= _SETTLED * (1 + cost):
                break
        return now

    def _normal(self, blocks: Sequence[_Block]) -> tuple[Any, Array]:
        """Return the normal matrix and the gradient."""
        from scipy.sparse import vstack

        slopes, residuals = [], []
        for block in blocks:
            weights = np.sqrt(block.weights)
            slopes.append(self._slopes(block, weights))
            residuals.append((block.residuals * weights[:, None]).ravel())
        rows = vstack(slopes).tocsc()
        return (rows.T @ rows).tocsc(), rows.T @ np.concatenate(residuals)

    def _slopes(self, block: _Block, weights: Array) -> Any:
        from scipy.sparse import csr_matrix

        count, rows, columns = block.slopes.shape
        at = np.broadcast_to(block.columns[:, None], block.slopes.shape).ravel()
        values = (block.slopes * weights[:, None, None]).ravel()
        ends = np.arange(count * rows + 1) * columns
        matrix = csr_matrix((values, at, ends), shape=(count * rows, self.kept[-1] + 1))
        return matrix[:, self.kept]

    def _move(self, now: BodyState, kept: Array) -> BodyState:
        step = np.zeros(self.kept[-1] + 1)
        step[self.kept] = kept
        frames = step[: self.shared].reshape(-1, _TWIST)
        markers = step[self.shared : -1].reshape(-1, MARKER)
        return BodyState(
            now.points_m + frames[:, :3],
            rotate(frames[:, 3:6]) @ now.turns,
            now.twists + frames[:, _POSE:],
            rotate(markers[:, :3]) @ now.marker_turns,
            now.centres_m + markers[:, 3:6],
            now.log_sides + markers[:, 6],
            now.log_print + float(step[-1]),
        )

    def covariance(self, now: BodyState) -> Array:
        """Return the covariance of the markers by the noise, the prints and the modes of the calibration."""
        modes = max(model.modes.shape[1] for model in self.cameras.values())
        by_mode = np.zeros((len(self.frame), 8, modes))
        sightings = self.sightings(now, by_mode)
        normal, _ = self._normal([sightings, *self._priors(now)])
        count = MARKER * len(self.ids)
        wanted = np.flatnonzero((self.kept >= self.shared) & (self.kept < self.shared + count))
        units = np.zeros((len(self.kept), len(wanted)))
        units[wanted, np.arange(len(wanted))] = 1.0
        inverse = _solve(normal, units)
        gains = self._slopes(sightings, sightings.weights) @ inverse
        errors = gains.T @ by_mode.reshape(len(gains), modes)
        places = self.kept[wanted] - self.shared
        covariance = np.zeros((count, count))
        covariance[np.ix_(places, places)] = inverse[wanted] + errors @ errors.T
        return covariance


def _cost(blocks: Sequence[_Block]) -> float:
    return float(sum(robust_loss(block.chi2, block.limit)[0].sum() for block in blocks))


def _solve(normal: Any, right: Array) -> Array:
    """Solve normal equations. In this order of the unknowns, the factors stay sparse."""
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    factors = splu(normal.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)
    return np.asarray(factors.solve(right))


# At most so many frames choose the start of a pair.
_VOTES = 60


def _most_consistent(poses: Array, length_m: float) -> Array:
    """Return the pose out of (n, 4, 4, 4), four of each frame, that is most similar to one of each frame."""
    poses = poses[np.linspace(0, len(poses) - 1, min(len(poses), _VOTES)).astype(int)]
    each = poses.reshape(-1, 1, 1, 4, 4)
    apart = angles_between(each[..., :3, :3], poses[None, ..., :3, :3])
    apart = apart + np.linalg.norm(each[..., :3, 3] - poses[None, ..., :3, 3], axis=-1) / length_m
    votes = np.minimum(apart.min(axis=2), 1.0).sum(axis=1)
    return np.asarray(each[int(votes.argmin()), 0, 0])
