"""Sightings of robots from the positions of a frame: by robot, at their capture times, with their errors."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Model, Position, Rig
from ipsys_log.models.tracking.bias_modes import BiasModes
from ipsys_log.models.tracking.filter import UNKNOWN_RAD2, Sightings
from ipsys_log.models.tracking.tracks import Robot
from ipsys_log.vision.bodies import BodyShape, body_shapes, rpy_from_rotation
from ipsys_log.vision.poses import invert_pose, rotation, skew_matrices

# An offset is used after this number of frames
_FEWEST_FRAMES = 10
# that agree within these gates.
_AGREES_M = 0.01
_AGREES_RAD = 0.05
# Noise below this is not resolved: it keeps covariances of known heights positive definite.
_LEAST_M, _LEAST_RAD = 1e-4, 1e-4
# The usual noise of positions and headings that have none: a few hundredths of a pixel.
_USUAL_M, _USUAL_RAD = 3e-4, 3e-3
# The error of a position whose covariance is unknown, and of such a rotation.
_UNKNOWN_M, _UNKNOWN_RAD = 0.005, 0.05
# The amplitudes of free bodies: 20 of the calibration, and one of the size.
FREE_MODES = 21
# No lab is larger, and no heading has a larger error.
_FARTHEST_M, _LARGEST_RAD = 1e6, 10.0
_UNKNOWN_POSE = np.diag(np.repeat([_UNKNOWN_M, _UNKNOWN_RAD], 3) ** 2)
_LEAST_POSE = np.diag(np.repeat([_LEAST_M, _LEAST_RAD], 3) ** 2)
_PLACE, _UNKNOWN = np.arange(3), np.full((3, 3), np.nan)
_LEAST_EYE_M2, _USUAL_EYE_M2, _UNKNOWN_EYE_M2 = (
    sigma_m**2 * np.eye(3) for sigma_m in (_LEAST_M, _USUAL_M, _UNKNOWN_M)
)


@dataclass(frozen=True, slots=True, eq=False)
class FrameSightings:
    """The sightings of one frame, (k,) of each: the arguments of ``RobotTracks.observe``."""

    camera: str
    robots: Sequence[Robot]
    times_ns: Sequence[int]
    sightings: Sightings
    inside: Sequence[bool | None]
    has_covariance: Sequence[bool]


class FrameReader:
    """The reader of positions, with the rig and the errors of the calibration.

    Parameters
    ----------
    model : the model of the positions; None for positions of another program.
    """

    def __init__(self, model: Model | None) -> None:
        self._model = model
        self._rig: Rig | None = None
        self._robots: dict[int, Robot] = {}
        self.modes = BiasModes.none()
        self._shapes: dict[int, BodyShape] = {}
        self._offsets = _Offsets({})

    def use_rig(self, rig: Rig) -> None:
        """Use a rig for the next frames."""
        shapes = {shape.robot: shape for shape in body_shapes(rig)}
        self._shapes = {m.id: shapes[m.robot] for m in rig.markers if m.robot in shapes}
        self._offsets = _Offsets({id_: one for id_, one in self._shapes.items() if one.is_level})
        self._rig, self._robots = rig, {}
        if self._model is not None:
            # Late: the modes of a joint model need scipy.
            from ipsys_log.models.tracking.calibration_modes import calibration_modes

            self.modes = calibration_modes(self._model, rig)

    def read(self, camera: str, time_ns: int, positions: Sequence[Position]) -> Iterator[FrameSightings]:
        """Yield the sightings of a frame of a camera at a time: of level robots, and of free bodies."""
        positions = [position for position in positions if _is_usable(position)]
        level = [position for position in positions if position.rotation_rad is None]
        free = [position for position in positions if position.rotation_rad is not None]
        if level:
            sightings, has_covariance = _read_sightings(camera, level, self.modes)
            robots = [self._robots.get(p.id) or self._robot_of(p.id) for p in level]
            if self._offsets:
                ids = [position.id for position in level]
                rows = self._offsets.learn(ids, sightings)
                level, robots = [level[row] for row in rows], [robots[row] for row in rows]
                own = np.array(rows, dtype=np.intp)
                sightings = self._offsets.move([ids[row] for row in rows], sightings.take(own))
                has_covariance = has_covariance[own]
            if level:
                yield _frame(camera, time_ns, level, robots, sightings, has_covariance.tolist())
        if free:
            robots = [self._robots.get(p.id) or self._robot_of(p.id) for p in free]
            pivots = [self._shapes[p.id].body_from_pivot if p.id in self._shapes else np.eye(4) for p in free]
            known = [_pose_noise(position) is not None for position in free]
            yield _frame(camera, time_ns, free, robots, _read_free(free, pivots), known)

    def _robot_of(self, marker_id: int) -> Robot:
        assert self._rig is not None
        shape = self._shapes.get(marker_id)
        number = marker_id if shape is None else shape.id
        robot = self._robots[marker_id] = (self._rig.robot_of(marker_id), number)
        return robot


def _frame(
    camera: str,
    time_ns: int,
    positions: Sequence[Position],
    robots: Sequence[Robot],
    sightings: Sightings,
    has_covariance: Sequence[bool],
) -> FrameSightings:
    times_ns = [time_ns + (position.time_offset_ns or 0) for position in positions]
    inside = [position.inside for position in positions]
    return FrameSightings(camera, robots, times_ns, sightings, inside, has_covariance)


def _numbers(values: Array | None, shape: tuple[int, ...]) -> Array:
    """Return an array of a shape, 0 for a missing one and for other numbers in a log of another program."""
    size = abs(int(np.prod(shape)))
    if values is None or values.size % size or not (np.abs(values) < _FARTHEST_M).all():
        return np.zeros([max(length, 0) for length in shape])
    return values.reshape(shape)


def _pose_noise(position: Position) -> Array | None:
    """Return the covariance of the pose of a free body; None if it is unknown or not positive definite."""
    noise = position.still_noise
    if noise is None or not (np.abs(noise) < _FARTHEST_M).all():
        return None
    return noise if np.linalg.eigvalsh(noise)[0] > 0 else None


def _read_free(positions: Sequence[Position], pivots: Sequence[Array]) -> Sightings:
    """Return the sightings of the pivots (4, 4) of free bodies from the positions of the bodies."""
    count = len(positions)
    poses, noise = np.zeros((count, 6)), np.zeros((count, 6, 6))
    modes, turns = np.zeros((count, 7, FREE_MODES)), np.empty((count, 3, 3))
    by_motion = np.zeros((count, 6, 6))
    for row, (position, pivot) in enumerate(zip(positions, pivots, strict=True)):
        assert position.rotation_rad is not None
        to_still = _numbers(position.to_still, (6,))
        turn = rotation(to_still[3:]) @ rotation(position.rotation_rad)
        arm_m = turn @ pivot[:3, 3]
        poses[row, :3] = np.array([position.x_m, position.y_m, position.z_m]) + to_still[:3] + arm_m
        turns[row] = turn @ pivot[:3, :3]
        # A turn of the body moves the pivot around its origin.
        by_pose = np.eye(6)
        by_pose[:3, 3:] = -skew_matrices(arm_m[None])[0]
        known = _pose_noise(position)
        noise[row] = by_pose @ (_UNKNOWN_POSE if known is None else known) @ by_pose.T + _LEAST_POSE
        own = _numbers(position.error_modes, (7, -1))
        modes[row, :, : own.shape[1]] = own[:, :FREE_MODES]
        modes[row, :6] = by_pose @ modes[row, :6]
        # The rates are those of the pivot: the body moves around it.
        by_motion[row] = by_pose @ _numbers(position.still_by_motion, (6, 6)) @ np.linalg.inv(by_pose)
    return Sightings(poses, noise, modes[:, :6], modes[:, 6], turns, by_motion)


@dataclass(slots=True, eq=False)
class _Offset:
    """The mean pose of a pivot in the axes of a marker: x, y, z and heading, (4,)."""

    mean: Array
    frames: int = 1

    def add(self, offset: Array) -> None:
        """Add the offset in one frame; start again if it disagrees."""
        change = offset - self.mean
        change[3] = (change[3] + np.pi) % (2 * np.pi) - np.pi
        if np.abs(change[:3]).max() > _AGREES_M or abs(change[3]) > _AGREES_RAD:
            # A single wrong frame does not end a long agreement.
            self.frames -= 1
            if self.frames < 1:
                self.mean, self.frames = offset, 1
            return
        self.frames = min(self.frames + 1, 100 * _FEWEST_FRAMES)
        self.mean = self.mean + change / self.frames


@dataclass(slots=True, eq=False)
class _Offsets:
    """From the markers of level bodies to their pivots: x, y, z and heading, (4,), in the axes of a marker.

    The rig has those of some markers. Frames that show another marker beside the first one of its body tell
    where it is.
    """

    shapes: Mapping[int, BodyShape]
    learned: dict[int, _Offset] = field(default_factory=dict)
    known: dict[int, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for marker_id, shape in self.shapes.items():
            if marker_id in shape.markers:
                marker_from_pivot = invert_pose(shape.markers[marker_id]) @ shape.body_from_pivot
                yaw_rad = rpy_from_rotation(marker_from_pivot[:3, :3])[2]
                self.known[marker_id] = np.array([*marker_from_pivot[:3, 3], yaw_rad])

    def __bool__(self) -> bool:
        return bool(self.shapes)

    def learn(self, ids: Sequence[int], sightings: Sightings) -> list[int]:
        """Learn from the sightings of one frame; return the rows of those whose pivots are known."""
        poses, known_headings = sightings.poses, sightings.noise[:, 3, 3] < UNKNOWN_RAD2
        rows = {marker_id: row for row, marker_id in enumerate(ids) if known_headings[row]}
        for marker_id, row in rows.items():
            shape = self.shapes.get(marker_id)
            reference = None if shape is None else rows.get(shape.id)
            if reference is None or shape is None or marker_id in shape.markers:
                continue
            pivot = _add_offset(poses[reference], self.known[shape.id])
            offset = pivot - poses[row]
            offset[:2] = _turn(-poses[row, 3]) @ offset[:2]
            learned = self.learned.setdefault(marker_id, _Offset(offset))
            learned.add(offset)
            if learned.frames >= _FEWEST_FRAMES:
                self.known[marker_id] = learned.mean
        return [
            row
            for row, marker_id in enumerate(ids)
            if marker_id not in self.shapes or marker_id in self.known
        ]

    def move(self, ids: Sequence[int], sightings: Sightings) -> Sightings:
        """Return the sightings of the pivots that follow from those of markers.

        A sighting without a heading does not tell where the pivot is: its noise becomes as large as the
        distance to it.
        """
        poses, noise = sightings.poses.copy(), sightings.noise.copy()
        sensitivities = sightings.sensitivities.copy()
        for row, marker_id in enumerate(ids):
            offset = self.known.get(marker_id)
            if offset is None or not offset.any():
                continue
            if noise[row, 3, 3] >= UNKNOWN_RAD2:
                noise[row, :2, :2] += (offset[:2] @ offset[:2]) * np.eye(2)
                continue
            arm_m = _turn(poses[row, 3]) @ offset[:2]
            poses[row] = _add_offset(poses[row], offset)
            # A turn of the marker moves the pivot around it.
            by_pose = np.eye(4)
            by_pose[:2, 3] = -arm_m[1], arm_m[0]
            noise[row] = by_pose @ noise[row] @ by_pose.T
            sensitivities[row] = by_pose @ sensitivities[row]
        return Sightings(poses, noise, sensitivities, sightings.clock_s)


def _add_offset(pose: Array, offset: Array) -> Array:
    """Return a pose (4,) moved by an offset (4,) in its own axes."""
    return np.concatenate([pose[:2] + _turn(pose[3]) @ offset[:2], pose[2:] + offset[2:]])


def _turn(angle_rad: float) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _is_usable(position: Position) -> bool:
    """Return whether a position is a place, and its rotation a turn; a log may hold other numbers."""
    turn_rad = position.rotation_rad
    return (
        -_FARTHEST_M < position.x_m < _FARTHEST_M
        and -_FARTHEST_M < position.y_m < _FARTHEST_M
        and -_FARTHEST_M < position.z_m < _FARTHEST_M
        and (turn_rad is None or bool((np.abs(turn_rad) < _LARGEST_RAD).all()))
    )


def _read_sightings(
    camera: str, positions: Sequence[Position], modes: BiasModes
) -> tuple[Sightings, NDArray[np.bool_]]:
    """Return the sightings of positions of one camera.

    Parameters
    ----------
    camera : its name.
    positions : (k,), at least one, all of them usable.
    modes : the errors of the calibration.

    Returns
    -------
    sightings : (k,).
    has_covariance : (k,), whether the covariance of a position is known and positive definite.
    """
    count = len(positions)
    noise, measured = np.zeros((count, 4, 4)), np.array([_heading(position) for position in positions])
    headings, noise[:, 3, 3] = measured[:, 0], measured[:, 1]
    noise[:, :3, :3], has_covariance = _position_noise(positions, camera in modes.tables)
    noise[:, _PLACE, _PLACE] += _LEAST_M**2
    poses = np.empty((count, 4))
    poses[:, :3], poses[:, 3] = [(p.x_m, p.y_m, p.z_m) for p in positions], headings
    clock_s = np.broadcast_to(modes.clock_of(camera), (count, modes.count))
    return Sightings(poses, noise, modes.at(camera, poses, headings), clock_s), has_covariance


def _position_noise(positions: Sequence[Position], has_modes: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Return the covariances (k, 3, 3) of the noise, and a mask of the positions with a covariance.

    Without modes, all errors of a position count as noise.
    """
    covariances_m2 = [_UNKNOWN if p.covariance_m2 is None else p.covariance_m2 for p in positions]
    if not has_modes:
        noise_m2 = np.array(covariances_m2)
        known = _are_covariances(noise_m2)
    else:
        noises_m2 = [_UNKNOWN if p.noise_m2 is None else p.noise_m2 for p in positions]
        both_m2 = np.array([covariances_m2, noises_m2])
        noise_m2 = both_m2[1].copy()
        # The noise of a marker on a flat floor has no vertical part.
        both_m2[1] += _LEAST_EYE_M2
        known, stated = _are_covariances(both_m2)
        noise_m2 = np.where(stated[:, None, None], noise_m2, _USUAL_EYE_M2)
    return np.where(known[:, None, None], noise_m2, _UNKNOWN_EYE_M2), known


def _are_covariances(matrices_m2: Array) -> NDArray[np.bool_]:
    """Return a mask (...) of the positive definite ones of matrices (..., 3, 3), by their minors."""
    rows = matrices_m2.reshape(*matrices_m2.shape[:-2], 9)
    xx, xy, xz, _, yy, yz, _, _, zz = rows.transpose(-1, *range(rows.ndim - 1))  # faster than np.moveaxis
    usable = (np.abs(rows) < _FARTHEST_M).all(axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        minor = xx * yy - xy * xy
        determinant = zz * minor - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz)
    return np.asarray(usable & (xx > 0) & (yy > 0) & (zz > 0) & (minor > 0) & (determinant > 0))


def _heading(position: Position) -> tuple[float, float]:
    """Return the heading of a position, and the variance of its noise."""
    heading_rad, noise_rad = position.heading_rad, position.heading_noise_rad
    if heading_rad is None or not isfinite(heading_rad):
        return 0.0, UNKNOWN_RAD2
    if noise_rad is None or not 0 <= noise_rad < _LARGEST_RAD:
        return heading_rad, _USUAL_RAD**2
    return heading_rad, noise_rad**2 + _LEAST_RAD**2
