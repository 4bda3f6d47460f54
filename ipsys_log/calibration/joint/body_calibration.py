"""Calibration of a rigid body: the poses and sides of its markers, from frames that show several of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Marker, Markers, Message, Rig
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import marker_corners_m, pose_from_rpy, rpy_from_rotation
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.poses import cross, make_pose, rotate, rotation_vectors

# More frames take longer than seconds, and the noise is no longer the largest error.
_MOST_FRAMES = 300
_LEAST_FRAMES = 5
# Relative standard deviations of printed sides: of all prints of a printer, and of one print.
_PRINT_SIGMA, _SIDE_SIGMA = 0.002, 0.001
# Frames that are at most so far apart are linked by the usual acceleration of a carried body, per axis.
_LINKED_S = 0.1
_ACCELERATIONS = np.repeat([4.0, 20.0], 3)  # in m/s^2 and rad/s^2
# Poses by two calibrated cameras differ by about this much, in m and rad.
_CAMERAS_APART = np.repeat([0.001, 0.001], 3)
# Poses that are measured by hand differ from the true ones by less.
_BY_HAND_M, _BY_HAND_RAD = 0.005, np.radians(5.0)
_CONTRADICTED = 4.0  # standard deviations
# A marker with a larger share of sightings that contradict the others came loose.
_LOOSE_SHARE = 0.2
_ROUNDS, _DAMPING, _SETTLED = 40, 1e-4, 1e-9
# Median of chi2 with eight degrees of freedom.
_MEDIAN_CHI2 = 7.344
_POSE, _TWIST, _MARKER = 6, 12, 7


class CalibratedMarker(NamedTuple):
    """The pose of a marker on its body, and its side.

    ``xyz_sigmas_m`` and ``turn_sigmas_rad`` (in the axes of the first marker) and ``length_sigma_m`` are
    standard deviations at the estimated size of the body, without :attr:`BodyCalibration.scale_sigma`.
    """

    id: int
    xyz_m: tuple[float, ...]
    rpy_rad: tuple[float, ...]
    length_m: float
    xyz_sigmas_m: tuple[float, ...]
    turn_sigmas_rad: tuple[float, ...]
    length_sigma_m: float
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class BodyCalibration:
    """A calibrated body.

    Attributes
    ----------
    robot : its name.
    markers : those whose poses are determined, in the order of the rig.
    scale_sigma : relative standard deviation of its size.
    frames, linked_frames : the number of frames, and of those shortly after a frame of another camera.
    remarks : what is not determined, and what contradicts the rig.
    covariance : (7 k, 7 k), of the turn, the centre and the logarithm of the side of each marker, in the axes
        of the first marker, with the scale. The pose of the first marker has none.
    """

    robot: str
    markers: tuple[CalibratedMarker, ...]
    scale_sigma: float
    frames: int
    linked_frames: int
    remarks: tuple[str, ...]
    covariance: Array

    def apply(self, rig: Rig) -> Rig:
        """Return a rig with the poses and sides of the markers, and with the uncertainty of the size."""
        found = {marker.id: marker for marker in self.markers}
        markers = tuple(
            replace(m, xyz_m=_short(own.xyz_m), rpy_rad=_short(own.rpy_rad), length_m=round(own.length_m, 6))
            if (own := found.get(m.id)) is not None
            else m
            for m in rig.markers
        )
        bodies = tuple(
            replace(body, scale_sigma=float(f"{self.scale_sigma:.2g}")) if body.robot == self.robot else body
            for body in rig.bodies
        )
        return replace(rig, markers=markers, bodies=bodies)


def calibrate_body(
    cameras: Mapping[str, JointModel], rig: Rig, robot: str, messages: Iterable[Message]
) -> BodyCalibration:
    """Estimate the poses of the markers of a body, and their printed sides.

    The unknowns are those of the markers, and a pose and a twist of the body in each frame. The size of the
    body comes from the prints, and from frames of two cameras shortly after each other.

    Parameters
    ----------
    cameras : the calibrated cameras.
    rig : names the markers of the body; the first one has the axes of the body, or its pose in the rig.
    robot : the body.
    messages : the markers in the frames of the cameras.

    Raises
    ------
    IpsysError
        The body is not in the rig or has one marker, or no frames show two of its markers.
    """
    ids = [marker.id for marker in rig.markers if marker.robot == robot]
    if all(body.robot != robot for body in rig.bodies):
        known = ", ".join(body.robot for body in rig.bodies) or "none"
        raise IpsysError(f"{robot}: is no body of the rig, which has {known}; add it to [[bodies]]")
    if len(ids) < 2:
        raise IpsysError(f"{robot}: has one marker, whose pose is that of the body; nothing to calibrate")
    frames = [frame for frame in _read_frames(cameras, ids, messages) if frame.markers]
    if not frames:
        numbers = ", ".join(map(str, ids))
        raise IpsysError(f"{robot}: no frame shows its markers {numbers}; carry it below the cameras")
    frames = [frame for frame in frames if len(frame.markers) > 1]
    ids, remarks = _determined(robot, ids, frames)
    frames = [kept for frame in frames if len((kept := frame.of(ids)).markers) > 1]
    return _Body(cameras, rig, robot, ids, _spread(frames)).calibrate(remarks, frames)


class _Frame(NamedTuple):
    """The markers of a body in a frame, and the times of their exposures by the common clock."""

    camera: str
    markers: list[Marker]
    times_ns: list[int]

    @property
    def time_ns(self) -> int:
        return sum(self.times_ns) // len(self.times_ns)

    def of(self, ids: Sequence[int]) -> _Frame:
        rows = [n for n, marker in enumerate(self.markers) if marker.id in ids]
        return _Frame(self.camera, [self.markers[n] for n in rows], [self.times_ns[n] for n in rows])


def _read_frames(
    cameras: Mapping[str, JointModel], ids: Sequence[int], messages: Iterable[Message]
) -> list[_Frame]:
    frames = []
    for message in messages:
        model = cameras.get(str(message.camera))
        if model is None or not isinstance(message.payload, Markers):
            continue
        frame = _Frame(str(message.camera), [], [])
        for marker in message.payload.markers:
            if marker.id in ids and np.isfinite(undistort(marker.corners_px, model.calibration)).all():
                later_s = float(marker.corners_px[:, 1].mean()) * model.row_time_s + model.clock_s
                later_ns = (marker.time_offset_ns or 0) + round(later_s * NS_PER_S)
                frame.markers.append(marker)
                frame.times_ns.append(message.publish_time_ns + later_ns)
        frames.append(frame)
    return sorted((frame for frame in frames if frame.markers), key=lambda frame: frame.time_ns)


def _determined(robot: str, ids: Sequence[int], frames: Sequence[_Frame]) -> tuple[list[int], list[str]]:
    """Return the ids of the markers whose poses are determined, and the reasons why others are not."""
    together = _pairs(frames)
    counts = {i: sum(i in [m.id for m in frame.markers] for frame in frames) for i in ids}
    often = [i for i in ids if counts[i] >= _LEAST_FRAMES]
    remarks = [
        f"marker {i} of {robot} is in {counts[i]} frames together with another one; {_LEAST_FRAMES} are "
        "needed. Turn it to a camera while you carry the body"
        for i in ids
        if i not in often
    ]
    linked, waiting = set[int](), [ids[0]]
    while waiting:
        i = waiting.pop()
        linked.add(i)
        waiting += [j for j in often if j not in linked and len(together.get((min(i, j), max(i, j)), ())) > 1]
    apart = [i for i in often if i not in linked]
    if apart:
        groups = " and ".join(", ".join(map(str, group)) for group in (sorted(linked), apart))
        remarks.append(
            f"the markers {groups} of {robot} are never seen together; carry the body so that one "
            "image shows a marker of each group"
        )
    if len(linked) < 2:
        raise IpsysError(f"{robot}: its first marker {ids[0]} has no partner: {remarks[0]}")
    return [i for i in ids if i in linked], remarks


def _pairs(frames: Sequence[_Frame]) -> dict[tuple[int, int], list[int]]:
    """Return the numbers of the frames that show both markers of a pair."""
    pairs: dict[tuple[int, int], list[int]] = {}
    for number, frame in enumerate(frames):
        for pair in combinations(sorted(marker.id for marker in frame.markers), 2):
            pairs.setdefault(pair, []).append(number)
    return pairs


def _spread(frames: Sequence[_Frame]) -> list[_Frame]:
    """Return some frames: those seen by two cameras, those of each pair of markers, and others over the time.

    Each of the three parts is spread evenly over the time.
    """
    if len(frames) <= _MOST_FRAMES:
        return list(frames)
    part, pairs = _MOST_FRAMES // 3, _pairs(frames)
    linked = [n for n in range(len(frames) - 1) if _links_cameras(frames[n], frames[n + 1])]
    kept = {n + after for n in _evenly(linked, part // 2) for after in (0, 1)}
    kept |= {n for rows in pairs.values() for n in _evenly(rows, part // len(pairs))}
    rest = [n for n in range(len(frames)) if n not in kept]
    return [frames[n] for n in sorted([*kept, *_evenly(rest, _MOST_FRAMES - len(kept))])]


def _links_cameras(first: _Frame, second: _Frame) -> bool:
    return first.camera != second.camera and 0 < second.time_ns - first.time_ns < _LINKED_S * NS_PER_S


def _evenly(rows: Sequence[int], count: int) -> list[int]:
    return [rows[n] for n in np.linspace(0, len(rows) - 1, min(max(count, 1), len(rows))).astype(int)]


class _State(NamedTuple):
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


class _Body:
    """The least squares of a body over its sightings: n sightings of k markers in f frames."""

    def __init__(
        self,
        cameras: Mapping[str, JointModel],
        rig: Rig,
        robot: str,
        ids: Sequence[int],
        frames: Sequence[_Frame],
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
        self.linked = np.flatnonzero((np.diff(self.frame_s) < _LINKED_S) & (np.diff(self.frame_s) > 0))
        self.shared = _TWIST * len(frames)
        width = self.shared + _MARKER * len(ids) + 1
        # The pose of the first marker is that of the body.
        self.kept = np.delete(np.arange(width), self.shared + np.arange(_POSE))

    def calibrate(self, remarks: list[str], frames: Sequence[_Frame]) -> BodyCalibration:
        now = self._refine(self._start())
        # Bent prints and compressed images have larger errors than the noise of their corners.
        chi2 = self._sightings(now).chi2
        freedom = 1 - _POSE * len(self.frames) / (8 * len(chi2))
        noise = max(1.0, float(np.median(chi2)) / (_MEDIAN_CHI2 * max(freedom, 0.1)))
        self.whitening /= np.sqrt(noise)
        now = self._refine(now)
        covariance = self._covariance(now)
        scale = np.zeros(len(covariance))
        scale[6::_MARKER] = 1 / len(self.ids)
        by_scale = covariance @ scale
        scale_sigma = float(np.sqrt(scale @ by_scale))
        own = np.sqrt(np.maximum((covariance - np.outer(by_scale, by_scale) / scale_sigma**2).diagonal(), 0))
        base = _pose_in(self.rig, self.ids[0])
        markers = []
        for n, i in enumerate(self.ids):
            pose = base @ make_pose(now.marker_turns[n], now.centres_m[n])
            side_m, sigmas = float(np.exp(now.log_sides[n])), own[_MARKER * n :].tolist()
            count = sum(marker.id == i for frame in frames for marker in frame.markers)
            place = tuple(pose[:3, 3].tolist()), rpy_from_rotation(pose[:3, :3]), side_m
            spread = tuple(sigmas[3:6]), tuple(sigmas[:3]), side_m * sigmas[6]
            markers.append(CalibratedMarker(i, *place, *spread, count))
        linked = sum(map(_links_cameras, self.frames, self.frames[1:]))
        remarks = [*remarks, *self._loose(now), *self._odd_sides(now, own), *self._odd_poses(markers)]
        return BodyCalibration(
            self.robot, tuple(markers), scale_sigma, len(self.frames), linked, tuple(remarks), covariance
        )

    def _start(self) -> _State:
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
        return _State(points_m, turns, twists, markers[:, :3, :3], markers[:, :3, 3], sides, 0.0)

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

    def _sightings(self, now: _State, by_mode: Array | None = None) -> _Block:
        """Return the residuals of the corners; ``by_mode`` (n, 8, m) gets those by the modes."""
        count = len(self.frame)
        residuals, slopes = np.zeros((count, 8)), np.zeros((count, 8, _TWIST + _MARKER))
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
        of_marker = self.shared + _MARKER * self.marker[:, None] + np.arange(_MARKER)
        residuals = (self.whitening @ residuals[..., None])[..., 0]
        return _Block(
            residuals, np.hstack([of_frame, of_marker]), self.whitening @ slopes, float(limit_of(8.0))
        )

    def _priors(self, now: _State) -> Iterator[_Block]:
        """Yield the residuals of the motion and of the prints."""
        frames, last = len(self.frames), self.kept[-1:]
        columns = np.arange(0, self.shared, _TWIST)[:, None] + np.arange(_POSE, _TWIST)
        slopes = np.tile(np.diag(1 / TWIST_SIGMAS), (frames, 1, 1))
        yield _Block(now.twists / TWIST_SIGMAS, columns, slopes, np.inf)
        odd = (now.log_sides - np.log(self.lengths_m) - now.log_print) / _SIDE_SIGMA
        columns = np.column_stack(np.broadcast_arrays(np.arange(self.shared + _POSE, last[0], _MARKER), last))
        slopes = np.tile([1.0, -1.0], (len(odd), 1, 1)) / _SIDE_SIGMA
        limit = float(limit_of(1.0))
        yield _Block(odd[:, None], columns, slopes, limit)
        slopes = np.full((1, 1, 1), 1 / _PRINT_SIGMA)
        yield _Block(slopes[0] * now.log_print, last[:, None], slopes, limit)
        if len(self.linked):
            yield self._links(now)

    def _links(self, now: _State) -> _Block:
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

    def _refine(self, now: _State) -> _State:
        """Return the unknowns after steps of Levenberg and Marquardt."""
        from scipy.sparse import diags

        blocks = [self._sightings(now), *self._priors(now)]
        cost, damping = _cost(blocks), _DAMPING
        normal, gradient = self._normal(blocks)
        for _ in range(_ROUNDS):
            step = _solve(normal + diags(damping * normal.diagonal()), -gradient)
            expected = -float(step @ gradient)
            tried = self._move(now, step)
            blocks = [self._sightings(tried), *self._priors(tried)]
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

    def _move(self, now: _State, kept: Array) -> _State:
        step = np.zeros(self.kept[-1] + 1)
        step[self.kept] = kept
        frames = step[: self.shared].reshape(-1, _TWIST)
        markers = step[self.shared : -1].reshape(-1, _MARKER)
        return _State(
            now.points_m + frames[:, :3],
            rotate(frames[:, 3:6]) @ now.turns,
            now.twists + frames[:, _POSE:],
            rotate(markers[:, :3]) @ now.marker_turns,
            now.centres_m + markers[:, 3:6],
            now.log_sides + markers[:, 6],
            now.log_print + float(step[-1]),
        )

    def _covariance(self, now: _State) -> Array:
        """Return the covariance of the markers by the noise, the prints and the modes of the calibration."""
        modes = max(model.modes.shape[1] for model in self.cameras.values())
        by_mode = np.zeros((len(self.frame), 8, modes))
        sightings = self._sightings(now, by_mode)
        normal, _ = self._normal([sightings, *self._priors(now)])
        count = _MARKER * len(self.ids)
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

    def _loose(self, now: _State) -> Iterator[str]:
        sightings = self._sightings(now)
        odd = sightings.chi2 > 2 * sightings.limit
        for n, i in enumerate(self.ids):
            own = odd[self.marker == n]
            if own.mean() > _LOOSE_SHARE:
                times_s = self.frame_s[self.frame[(self.marker == n) & odd]]
                yield (
                    f"marker {i} of {self.robot} contradicts the others in {own.sum()} of {len(own)} frames, "
                    f"from {times_s[0]:.1f} s to {times_s[-1]:.1f} s: it came loose. Fix it and carry the "
                    "body again"
                )

    def _odd_sides(self, now: _State, own: Array) -> Iterator[str]:
        ratios = now.log_sides - np.log(self.lengths_m)
        common = float(np.median(ratios))
        if abs(common) > _CONTRADICTED * _PRINT_SIGMA:
            size = f"{abs(100 * np.expm1(common)):.1f} % {'larger' if common > 0 else 'smaller'}"
            yield f"the markers of {self.robot} are printed {size} than length_m in the rig; measure them"
        for n, i in enumerate(self.ids):
            if abs(ratios[n] - common) > _CONTRADICTED * np.hypot(_SIDE_SIGMA, own[_MARKER * n + 6]):
                side_mm = 1000 * np.exp(now.log_sides[n] - common)
                yield (
                    f"marker {i} of {self.robot} has a side of {side_mm:.1f} mm beside the others, but "
                    f"{1000 * self.lengths_m[n]:.1f} mm in the rig; measure its black square"
                )

    def _odd_poses(self, markers: Sequence[CalibratedMarker]) -> Iterator[str]:
        """Yield a line on the poses of the rig that contradict the estimate."""
        found = {m.id: m for m in markers if any(r.id == m.id and r.xyz_m for r in self.rig.markers)}
        poses = {i: _pose_in(self.rig, i) for i in found}
        apart_m = np.array([poses[i][:3, 3] - m.xyz_m for i, m in found.items()]).reshape(-1, 3)
        most_m = np.array([_BY_HAND_M + _CONTRADICTED * np.max(m.xyz_sigmas_m) for m in found.values()])
        turns = np.array(
            [poses[i][:3, :3].T @ pose_from_rpy((), m.rpy_rad)[:3, :3] for i, m in found.items()]
        )
        angles = angles_between(turns.reshape(-1, 3, 3), np.eye(3))
        far = (np.abs(apart_m) > most_m[:, None]).any(axis=1)
        advice = "correct the rig, or write the estimate into it with --write"
        for axis, name in enumerate("xyz"):
            mirrored = apart_m.copy()
            mirrored[:, axis] += [2 * m.xyz_m[axis] for m in found.values()]
            if far.any() and (np.abs(mirrored) <= most_m[:, None]).all():
                text = f"the markers of {self.robot} in the rig are a mirror image"
                yield f"{text}: {name} has the other sign; {advice}"
                return
        for n, i in enumerate(found):
            if far[n] or angles[n] > _BY_HAND_RAD:
                yield (
                    f"marker {i} of {self.robot} is {1000 * np.linalg.norm(apart_m[n]):.0f} mm and "
                    f"{np.degrees(angles[n]):.0f} degrees away from its pose in the rig; {advice}"
                )


def _short(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return values rounded to 1 um or 1 urad, without -0."""
    return tuple(round(value, 6) + 0.0 for value in values)


def _pose_in(rig: Rig, marker_id: int) -> Array:
    marker = next(marker for marker in rig.markers if marker.id == marker_id)
    return pose_from_rpy(marker.xyz_m, marker.rpy_rad)


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
