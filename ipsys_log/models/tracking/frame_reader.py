"""Sightings of robots from the positions of a frame: by robot, at their capture times, with their errors."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Model, Position, Rig
from ipsys_log.models.tracking.bias_modes import BiasModes
from ipsys_log.models.tracking.filter import UNKNOWN_RAD2, Sightings
from ipsys_log.models.tracking.tracks import Robot

# An offset is used after this number of frames
_FEWEST_FRAMES = 10
# that agree within these gates.
_AGREES_M = 0.01
_AGREES_RAD = 0.05
# Noise below this is not resolved: it keeps covariances of known heights positive definite.
_LEAST_M, _LEAST_RAD = 1e-4, 1e-4
# The usual noise of positions and headings that have none: a few hundredths of a pixel.
_USUAL_M, _USUAL_RAD = 3e-4, 3e-3
# The error of a position whose covariance is unknown.
_UNKNOWN_M = 0.005
# No lab is larger, and no heading has a larger error.
_FARTHEST_M, _LARGEST_RAD = 1e6, 10.0
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
        self._bodies, self._has_bodies = _Bodies(), False

    def use_rig(self, rig: Rig) -> None:
        """Use a rig for the next frames."""
        names = [marker.robot for marker in rig.markers if marker.robot is not None]
        self._rig, self._has_bodies = rig, len(names) > len(set(names))
        self._robots = {}
        if self._model is not None:
            # Late: the modes of a joint model need scipy.
            from ipsys_log.models.tracking.calibration_modes import calibration_modes

            self.modes = calibration_modes(self._model, rig)

    def read(self, camera: str, time_ns: int, positions: Sequence[Position]) -> FrameSightings | None:
        """Return the sightings of a frame of a camera at a time; None if it shows no robot."""
        positions = [position for position in positions if _is_usable(position)]
        if not positions:
            return None
        sightings, has_covariance = _read_sightings(camera, positions, self.modes)
        robots = [self._robots.get(p.id) or self._robot_of(p.id) for p in positions]
        if self._has_bodies:
            self._bodies.learn(robots, sightings)
            rows = [row for row, robot in enumerate(robots) if self._bodies.knows(*robot)]
            positions, robots = [positions[row] for row in rows], [robots[row] for row in rows]
            sightings = self._bodies.move(robots, sightings.take(np.array(rows, dtype=np.intp)))
            has_covariance = has_covariance[rows]
            robots = [(name, self._bodies.reference(name, number)) for name, number in robots]
        return FrameSightings(
            camera,
            robots,
            [time_ns + (position.time_offset_ns or 0) for position in positions],
            sightings,
            [position.inside for position in positions],
            has_covariance.tolist(),
        )

    def _robot_of(self, marker_id: int) -> Robot:
        assert self._rig is not None
        robot = self._robots[marker_id] = (self._rig.robot_of(marker_id), marker_id)
        return robot


@dataclass(slots=True, eq=False)
class _Offset:
    """The mean pose of a marker relative to the reference marker of its robot: x, y, z and heading, (4,)."""

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
class _Bodies:
    """The robots with several markers.

    The first marker that is seen of a robot is its reference: the track of the robot is that of this marker.
    The rig does not tell where the others are. Frames that show two markers of a robot do.
    """

    references: dict[str, int] = field(default_factory=dict)
    offsets: dict[int, _Offset] = field(default_factory=dict)

    def reference(self, robot: str, marker_id: int) -> int:
        """Return the reference marker of a robot."""
        return self.references.setdefault(robot, marker_id)

    def learn(self, markers: Sequence[tuple[str, int]], sightings: Sightings) -> None:
        """Learn from the sightings of one frame: of k markers, each with the name of its robot and its id."""
        poses, known_headings = sightings.poses, sightings.noise[:, 3, 3] < UNKNOWN_RAD2
        rows = {marker_id: row for row, (_, marker_id) in enumerate(markers) if known_headings[row]}
        for marker_id, row in rows.items():
            robot = markers[row][0]
            reference = rows.get(self.reference(robot, marker_id))
            if reference is None or reference == row:
                continue
            offset = poses[row] - poses[reference]
            offset[:2] = _turn(-poses[reference, 3]) @ offset[:2]
            known = self.offsets.get(marker_id)
            if known is None:
                self.offsets[marker_id] = _Offset(offset)
            else:
                known.add(offset)

    def knows(self, robot: str, marker_id: int) -> bool:
        """Return whether the sighting of a marker is one of its robot's reference."""
        known = self.offsets.get(marker_id)
        return self.reference(robot, marker_id) == marker_id or (
            known is not None and known.frames >= _FEWEST_FRAMES
        )

    def move(self, markers: Sequence[tuple[str, int]], sightings: Sightings) -> Sightings:
        """Return the sightings of the reference markers that follow from those of known markers.

        A sighting without a heading does not tell where the reference is: its noise becomes as large as the
        distance of the markers.
        """
        poses, noise = sightings.poses.copy(), sightings.noise.copy()
        sensitivities = sightings.sensitivities.copy()
        for row, (robot, marker_id) in enumerate(markers):
            if self.reference(robot, marker_id) == marker_id:
                continue
            offset = self.offsets[marker_id].mean
            if noise[row, 3, 3] >= UNKNOWN_RAD2:
                noise[row, :2, :2] += (offset[:2] @ offset[:2]) * np.eye(2)
                continue
            heading_rad = poses[row, 3] - offset[3]
            arm_m = _turn(heading_rad) @ offset[:2]
            poses[row] -= [*arm_m, offset[2], offset[3]]
            # A turn of the marker moves the reference around it.
            by_pose = np.eye(4)
            by_pose[:2, 3] = arm_m[1], -arm_m[0]
            noise[row] = by_pose @ noise[row] @ by_pose.T
            sensitivities[row] = by_pose @ sensitivities[row]
        return Sightings(poses, noise, sensitivities, sightings.clock_s)


def _turn(angle_rad: float) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _is_usable(position: Position) -> bool:
    """Return whether a position is a place; the log of another program may hold other numbers."""
    return (
        -_FARTHEST_M < position.x_m < _FARTHEST_M
        and -_FARTHEST_M < position.y_m < _FARTHEST_M
        and -_FARTHEST_M < position.z_m < _FARTHEST_M
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
