"""Drives that a lab and another system record: real ones (mrclam6 in IPSYS_DATA) and simulated ones."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import map_coordinates
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from ipsys_log.messages import Array
from ipsys_log.statistics.calibration_points import TimedPoints
from ipsys_log.statistics.ground_truth import TrackedPath
from ipsys_log.statistics.trajectories import Trajectory, TrajectoryPair
from ipsys_log.units import NS_PER_S

# Positions (n, 2) in m and headings (n,) in rad at times (n,) in s.
Drive = Callable[[Array], tuple[Array, Array]]

_EPOCH_NS = 1_700_000_000 * NS_PER_S
RATE_HZ = 30.0
# The field repeats after this length, far above the extent of the paths (10 m).
_FIELD_M, _GRID_M = 16.0, 0.02
_MOST_INSTANTS = 1200


class TrackNoise(NamedTuple):
    """The errors of tracks; ``heading_rad`` is None without headings."""

    field_m: float = 0.003
    kernel: str = "gauss"
    heading_rad: float | None = float(np.radians(0.2))
    white_m: float = 0.001
    length_m: float = 0.5

    def correlation(self, distances_m: Array) -> Array:
        """Return the correlation of the field: squared-exponential or Matern 3/2."""
        scaled = distances_m / self.length_m
        if self.kernel == "gauss":
            return np.asarray(np.exp(-0.5 * scaled**2))
        return np.asarray((1 + np.sqrt(3) * scaled) * np.exp(-np.sqrt(3) * scaled))


@dataclass(frozen=True)
class OtherSystem:
    """The true relation of another system to the lab, in the terms of ``PathAlignment``.

    The clocks differ by ``offset_s`` at ``start_s``. One second of the other clock is ``1 + drift`` seconds.
    """

    start_s: float
    offset_s: float
    rotation: Rotation
    shift_m: Array
    pivot_m: Array
    turn_rad: float = 0.0
    drift: float = 0.0

    def clock_ns(self, times_s: Array) -> NDArray[np.int64]:
        return _ns(self.start_s - self.offset_s + (times_s - self.start_s) / (1 + self.drift))

    def offset_at_s(self, reference_ns: int) -> float:
        start_ns = _EPOCH_NS + round((self.start_s - self.offset_s) * NS_PER_S)
        return self.offset_s + self.drift * (reference_ns - start_ns) / NS_PER_S

    def record(self, drive: Drive, times_s: Array) -> Trajectory:
        """Return what the other system records of a drive at times of the lab."""
        points_m, headings_rad = drive(times_s)
        body_m = planar(points_m) + _about_z(headings_rad).apply(self.pivot_m)
        axes = self.rotation.inv() * _about_z(headings_rad + self.turn_rad)
        points_m = self.rotation.inv().apply(body_m - self.shift_m)
        return Trajectory("", self.clock_ns(times_s), points_m, axes.as_quat())


def _ns(times_s: Array) -> NDArray[np.int64]:
    return _EPOCH_NS + np.round(times_s * NS_PER_S).astype(np.int64)


def _about_z(angles_rad: Array) -> Rotation:
    return Rotation.from_euler("z", angles_rad[:, None])


def planar(points_m: Array) -> Array:
    """Return points (n, 3) on the floor."""
    return np.column_stack([points_m, np.zeros(len(points_m))])


def wrap(angles_rad: Array) -> Array:
    return np.asarray((angles_rad + np.pi) % (2 * np.pi) - np.pi)


@cache
def _root_spectrum(noise: TrackNoise) -> Array:
    """Return the square root of the spectrum of the field, of unit variance, on the grid of its period."""
    steps_m = np.arange(round(_FIELD_M / _GRID_M)) * _GRID_M
    steps_m = np.minimum(steps_m, _FIELD_M - steps_m)
    spectrum = np.fft.fft2(noise.correlation(np.hypot(steps_m[:, None], steps_m))).real
    return np.asarray(np.sqrt(np.maximum(spectrum, 0)))


def smooth_errors(rng: np.random.Generator, points_m: Array, noise: TrackNoise, axes: int) -> Array:
    """Return a random field at places (n, 2) of the floor, (n, axes): independent for each axis."""
    root, values = _root_spectrum(noise), []
    for _ in range(axes):
        field = np.fft.ifft2(root * np.fft.fft2(rng.normal(size=root.shape))).real
        values.append(map_coordinates(field, points_m.T / _GRID_M, order=1, mode="grid-wrap"))
    return noise.field_m * np.column_stack(values)


def make_track(
    rng: np.random.Generator, drive: Drive, times_s: Array, noise: TrackNoise, axes: int = 2
) -> TrackedPath:
    """Return the track that a camera lab makes of a drive, with errors in x and y, or also in z."""
    points_m, headings_rad = drive(times_s)
    track_m = planar(points_m)
    track_m[:, :axes] += smooth_errors(rng, points_m, noise, axes)
    track_m[:, :axes] += rng.normal(0, noise.white_m, (len(times_s), axes))
    sigma_rad = np.nan if noise.heading_rad is None else noise.heading_rad
    headings_rad = wrap(headings_rad + sigma_rad * rng.normal(size=len(times_s)))
    return TrackedPath("robot", TimedPoints(_ns(times_s), track_m), headings_rad)


@cache
def offset_bound_s(
    drive: Drive, start_s: float, length_s: float, noise: TrackNoise, rate_s: float = 1 / RATE_HZ
) -> float:
    """Return the Cramer-Rao bound of the offset: least squares with the true covariance of the errors.

    The unknowns are offset, rotation and translation on the floor, pivot, and the turn between headings.
    Only every k-th instant is used; the variance of the independent noise is divided by k. Velocities and
    turn rates are differences over ``rate_s``.
    """
    step = -(-int(length_s * RATE_HZ) // _MOST_INSTANTS)
    times_s = start_s + np.arange(0, length_s, step / RATE_HZ)
    points_m, headings_rad = drive(times_s)
    later, earlier = drive(times_s + rate_s / 2), drive(times_s - rate_s / 2)
    velocity, turn_rate = ((after - before) / rate_s for after, before in zip(later, earlier, strict=True))
    one, zero = np.ones(len(times_s)), np.zeros(len(times_s))
    cos, sin, (x_m, y_m) = np.cos(headings_rad), np.sin(headings_rad), points_m.T
    # Columns: offset, rotation, translation (2), pivot (2), turn between headings.
    design_x = np.column_stack([-velocity[:, 0], -y_m, one, zero, -cos, sin, zero])
    design_y = np.column_stack([-velocity[:, 1], x_m, zero, one, -sin, -cos, zero])
    design_heading = np.column_stack([-turn_rate, one, zero, zero, zero, zero, one])
    covariance = noise.field_m**2 * noise.correlation(cdist(points_m, points_m))
    covariance[np.diag_indices_from(covariance)] += noise.white_m**2 / step
    factor = cho_factor(covariance, lower=True)
    information = np.sum([one.T @ cho_solve(factor, one) for one in (design_x, design_y)], axis=0)
    if noise.heading_rad is None:
        information = information[:-1, :-1]
    else:
        information += design_heading.T @ design_heading * step / noise.heading_rad**2
    return float(np.sqrt(np.linalg.inv(information)[0, 0]))


def _rows(robot: int, kind: str) -> Array:
    folder = Path(os.environ.get("IPSYS_DATA", "../shared/data")) / "mrclam6"
    if not folder.is_dir():
        raise SystemExit(f"no real data in {folder}: set IPSYS_DATA (docs/data.md says where to get them)")
    return np.loadtxt(folder / f"Robot{robot}_{kind}.dat")


@cache
def vicon(robot: int) -> Array:
    """Return the path of a robot of mrclam6, (n, 4): time since its start, x, y, unwrapped heading."""
    rows = _rows(robot, "Groundtruth")
    return np.column_stack([rows[:, 0] - rows[0, 0], rows[:, 1:3], np.unwrap(rows[:, 3])])


@cache
def odometry(robot: int) -> Array:
    """Return the dead-reckoned path of a robot of mrclam6, as :func:`vicon`, in arcs between its rows."""
    rows = _rows(robot, "Odometry")
    # The last one of rows with equal stamps holds.
    rows = rows[np.append(np.diff(rows[:, 0]) > 0, True)]
    arc_m, turn_rad = rows[:-1, 1:].T * np.diff(rows[:, 0])
    heading_rad = np.append(0.0, np.cumsum(turn_rad))
    steps = arc_m * np.sinc(turn_rad / (2 * np.pi)) * np.exp(1j * (heading_rad[:-1] + turn_rad / 2))
    points = np.append(0.0, np.cumsum(steps))
    times_s = rows[:, 0] - _rows(robot, "Groundtruth")[0, 0]
    return np.column_stack([times_s, points.real, points.imag, heading_rad])


@cache
def vicon_drive(robot: int) -> Drive:
    """Return the path of a robot of mrclam6 between its instants."""
    known_s, *columns = vicon(robot).T

    def drive(times_s: Array) -> tuple[Array, Array]:
        x_m, y_m, heading_rad = (np.interp(times_s, known_s, column) for column in columns)
        return np.column_stack([x_m, y_m]), heading_rad

    return drive


def random_drive(rng: np.random.Generator, duration_s: float) -> Drive:
    """Return a smooth drive with stops along an epitrochoid."""
    radius_m, loops = rng.uniform(0.8, 1.5), rng.choice([-1, 1]) * rng.uniform(2.0, 4.0)
    loop_m, phase = radius_m * rng.uniform(0.4, 0.8) / abs(loops), rng.uniform(0, 2 * np.pi, 2)
    count = int(duration_s / 7) + 1
    lasts_s, rests_s, angles = (rng.uniform(*ends, count) for ends in ((6.0, 14.0), (1.0, 4.0), (0.8, 2.0)))
    begins_s = np.cumsum(lasts_s + rests_s) - lasts_s

    def drive(times_s: Array) -> tuple[Array, Array]:
        share = np.clip((times_s[:, None] - begins_s) / lasts_s, 0, 1)
        angle = (share - np.sin(2 * np.pi * share) / (2 * np.pi)) @ angles
        first = radius_m * np.exp(1j * (angle + phase[0]))
        second = loop_m * np.exp(1j * (loops * angle + phase[1]))
        points, tangents = first + second, 1j * (first + loops * second)
        return np.column_stack([points.real, points.imag]), np.unwrap(np.angle(tangents))

    return drive


def vicon_pair(
    robot: int, start_s: float, length_s: float, noise: TrackNoise, lever_m: float, seed: int
) -> tuple[TrajectoryPair, OtherSystem]:
    """Return a window of Vicon as the other system, its simulated track, and the true relation."""
    rng, times_s = np.random.default_rng([37, seed]), vicon(robot)[:, 0]
    turned = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])
    shift_m, pivot_m = np.append(rng.uniform(-5, 5, 2), 0.0), np.array([-lever_m, 0, 0])
    truth = OtherSystem(start_s, rng.uniform(-5, 5), turned, shift_m, pivot_m)
    drive, window_s = vicon_drive(robot), times_s[(times_s >= start_s) & (times_s <= start_s + length_s)]
    track = make_track(rng, drive, start_s + np.arange(0, length_s, 1 / RATE_HZ), noise)
    return TrajectoryPair(truth.record(drive, window_s), track), truth


def odometry_pair(robot: int, start_s: float, length_s: float) -> TrajectoryPair:
    """Return a window of dead-reckoned odometry as the other system, with Vicon as the track."""
    other, lab = (
        path[(path[:, 0] >= start_s) & (path[:, 0] <= start_s + length_s)]
        for path in (odometry(robot), vicon(robot))
    )
    trajectory = Trajectory("", _ns(other[:, 0]), planar(other[:, 1:3]), _about_z(other[:, 3]).as_quat())
    positions = TimedPoints(_ns(lab[:, 0]), planar(lab[:, 1:3]))
    return TrajectoryPair(trajectory, TrackedPath("robot", positions, wrap(lab[:, 3])))


def turn_rate_offset_s(robot: int, start_s: float, length_s: float, over_s: float = 0.5) -> float:
    """Return the offset of odometry, within 2 s, with the best correlation of turn rates over ``over_s``."""
    times_s = np.arange(start_s + 2, start_s + length_s - 2, 0.02)

    def rates(path: Array, offset_s: float) -> Array:
        ends_s = times_s - offset_s + np.array([[over_s / 2], [-over_s / 2]])
        return np.asarray(-np.diff(np.interp(ends_s, path[:, 0], path[:, 3]), axis=0)[0])

    lab_rates, offsets_s = rates(vicon(robot), 0.0), np.arange(-2, 2.005, 0.01)
    shares = [np.corrcoef(lab_rates, rates(odometry(robot), offset_s))[0, 1] for offset_s in offsets_s]
    return float(offsets_s[np.argmax(shares)])


def simulated_pair(number: int) -> tuple[TrajectoryPair, OtherSystem, str]:
    """Return a simulated drive, its true relation and its kind: of five, one is long, and one in 3D."""
    rng, kind = np.random.default_rng([37, 1, number]), number % 5
    length_s, is_3d = (600.0 if kind == 0 else 60.0), kind == 1
    drive, towards = random_drive(rng, length_s), rng.uniform(-np.pi, np.pi)
    turned = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])
    if is_3d:
        turned = Rotation.from_quat(rng.normal(size=4))
    shift_m = rng.uniform(-5, 5, 3) * [1, 1, is_3d]
    pivot_m = rng.uniform(0, 0.3) * np.array([np.cos(towards), np.sin(towards), 0])
    drift = rng.uniform(-50e-6, 50e-6) if kind == 0 else 0.0
    offset_s, turn_rad = rng.uniform(-5, 5), rng.uniform(-np.pi, np.pi)
    truth = OtherSystem(0.0, offset_s, turned, shift_m, pivot_m, turn_rad, drift)
    times_s = np.arange(0, length_s, 1 / RATE_HZ)
    track = make_track(rng, drive, times_s, TrackNoise(), 3 if is_3d else 2)
    pair = TrajectoryPair(truth.record(drive, np.arange(0, length_s, 0.01)), track)
    return pair, truth, {0: "2D, 600 s, drift", 1: "3D, 60 s"}.get(kind, "2D, 60 s")
