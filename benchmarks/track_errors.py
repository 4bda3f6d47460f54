"""Errors of tracks against the ground truth of a drive, and their figures over many labs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from track_contenders import RobotTrack
from track_drives import SeenDrive

from tests.geometric.floor_error import region_shares

__all__ = [
    "Figures",
    "LabErrors",
    "compute_coasting_errors",
    "compute_lab_errors",
    "find_gaps",
    "summarize_labs",
]

Array = NDArray[np.float64]
Times = NDArray[np.int64]
Mask = NDArray[np.bool_]
Figures = dict[str, float]

# The first part of a track, and steps over a longer gap, are in no figure.
_LEFT_OUT_NS, _MOST_GAP_NS = 500_000_000, 60_000_000
# A hand-over is a change of the cameras of this time.
_HAND_OVER_NS = 100_000_000
_GRID_NS = 1_000_000
# All cameras are covered for a while, again and again; the errors are sampled in these gaps.
_GAP_NS, _GAP_EVERY_NS, _GAP_STEP_NS = 600_000_000, 3_000_000_000, 50_000_000
# A robot is seen for at least this time before each gap. The times of the gaps have their own random numbers.
_SEEN_NS, _GAP_STREAM = 1_200_000_000, 1
_MM = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class LabErrors:
    """The errors of a contender in one lab, over all its robots. Distances are in mm, angles in degrees.

    ``at_rows``, ``between`` and ``coasting`` are 2D errors in m, (n, 2), each with covariances (n, 2, 2).
    """

    single_mm: float
    error_2d_mm: Array
    error_3d_mm: Array
    grid_mm: Array
    hand_over_mm: Array
    other_camera_mm: Array
    velocity_m_s: Array
    heading_deg: Array
    at_rows: tuple[Array, Array]
    between: tuple[Array, Array]
    coasting: tuple[Array, Array]


def compute_lab_errors(
    drive: SeenDrive, tracks: dict[int, RobotTrack], coasting: tuple[Array, Array] | None = None
) -> LabErrors:
    """Return the errors of the tracks of a drive, without the first half second of each.

    ``coasting`` are the errors while no camera sees a robot, from :func:`compute_coasting_errors`.
    """
    robots = [_robot_errors(drive, robot, track) for robot, track in tracks.items()]

    def join(key: str) -> Array:
        return np.concatenate([one[key] for one in robots])

    return LabErrors(
        single_error_mm(drive),
        join("error_2d_mm"),
        join("error_3d_mm"),
        join("grid_mm"),
        join("hand_over_mm"),
        join("other_camera_mm"),
        join("velocity_m_s"),
        join("heading_deg"),
        (join("errors_m"), join("covariances_m2")),
        (join("between_m"), join("between_covariances_m2")),
        coasting or (np.empty((0, 2)), np.empty((0, 2, 2))),
    )


def find_gaps(drive: SeenDrive) -> list[tuple[int, int]]:
    """Return intervals in which all cameras are covered: 0.6 s in every 3 s, at times from the lab's seed.

    With fixed times, the first robot would meet the same bends in every lab.
    """
    first_ns, last_ns = drive.positions[0].publish_time_ns, drive.positions[-1].publish_time_ns
    periods_ns = np.arange(first_ns, last_ns - _GAP_EVERY_NS, _GAP_EVERY_NS)
    rng = np.random.default_rng([drive.truth.lab.settings.lab.seed, _GAP_STREAM])
    starts_ns = periods_ns + rng.integers(_SEEN_NS, _GAP_EVERY_NS - _GAP_NS, len(periods_ns), endpoint=True)
    return [(start_ns, start_ns + _GAP_NS) for start_ns in starts_ns.tolist()]


def compute_coasting_errors(
    drive: SeenDrive, gaps_ns: Sequence[tuple[int, int]], tracks: dict[int, RobotTrack]
) -> tuple[Array, Array]:
    """Return the errors in the intervals without positions, and their covariances."""
    errors_m, covariances_m2 = [np.empty((0, 2))], [np.empty((0, 2, 2))]
    for robot, track in tracks.items():
        times_ns = [np.arange(start + _GAP_STEP_NS, end, _GAP_STEP_NS) for start, end in gaps_ns]
        within = np.concatenate([np.empty(0, dtype=np.int64), *times_ns])
        within = within[(within > track.times_ns[0] + _LEFT_OUT_NS) & (within < track.times_ns[-1])]
        points_m, covariances = track.predict(within)
        errors_m.append(points_m - _place(drive, robot, within))
        covariances_m2.append(covariances)
    return np.concatenate(errors_m), np.concatenate(covariances_m2)


def single_error_mm(drive: SeenDrive) -> float:
    """Return the mean 2D error of all positions of all cameras, in mm."""
    apart = []
    for robot, (times_ns, _, points_m) in drive.sightings.items():
        later = times_ns >= times_ns[0] + _LEFT_OUT_NS
        truth_m = drive.truth.poses(robot, times_ns[later])[:, :2]
        apart.append(np.linalg.norm(points_m[later, :2] - truth_m, axis=1))
    return float(_MM * np.concatenate(apart).mean())


def _robot_errors(drive: SeenDrive, robot: int, track: RobotTrack) -> dict[str, Array]:
    times_ns = track.times_ns
    poses = drive.truth.poses(robot, times_ns)
    errors_m = track.points_m - poses[:, :3]
    # A row without a sighting is a prediction.
    later = (times_ns >= times_ns[0] + _LEFT_OUT_NS) & np.isin(times_ns, drive.sightings[robot][0])
    turned_rad = (track.headings_rad - poses[:, 3] + np.pi) % (2 * np.pi) - np.pi
    grid_ns = np.arange(times_ns[0] + _LEFT_OUT_NS, times_ns[-1], _GRID_NS)
    middle_ns = _middles(times_ns[later])
    between_m, between_covariances_m2 = track.predict(middle_ns)
    steps_mm = _MM * np.linalg.norm(np.diff(errors_m[:, :2], axis=0), axis=1)
    near = (np.diff(times_ns) <= _MOST_GAP_NS) & later[:-1] & later[1:]
    handed_over, other = _changes(*drive.sightings[robot][:2], times_ns)
    return {
        "errors_m": errors_m[later, :2],
        "covariances_m2": track.covariances_m2[later],
        "error_2d_mm": _MM * np.linalg.norm(errors_m[later, :2], axis=1),
        "error_3d_mm": _MM * np.linalg.norm(errors_m[later], axis=1),
        "grid_mm": _MM * np.linalg.norm(track.predict(grid_ns)[0] - _place(drive, robot, grid_ns), axis=1),
        "hand_over_mm": steps_mm[near & handed_over],
        "other_camera_mm": steps_mm[near & other],
        "velocity_m_s": np.linalg.norm(
            (track.velocities_m_s - drive.truth.velocities(robot, times_ns))[later], axis=1
        ),
        "heading_deg": np.degrees(np.abs(turned_rad[later])),
        "between_m": between_m - _place(drive, robot, middle_ns),
        "between_covariances_m2": between_covariances_m2,
    }


def _place(drive: SeenDrive, robot: int, times_ns: Times) -> Array:
    return drive.truth.poses(robot, times_ns)[:, :2]


def _middles(times_ns: Times) -> Times:
    """Return the instants half-way between consecutive rows."""
    steps_ns = np.diff(times_ns)
    near = (steps_ns <= _MOST_GAP_NS) & (steps_ns > 1)
    middles: Times = times_ns[:-1][near] + steps_ns[near] // 2
    return middles


def _changes(seen_ns: Times, cameras: NDArray[np.str_], times_ns: Times) -> tuple[Mask, Mask]:
    """Return masks (n - 1,) of the steps between rows: a hand-over, and a row of another camera.

    A hand-over changes the set of the cameras that saw the robot in the last 100 ms.
    """
    first = np.searchsorted(seen_ns, times_ns - _HAND_OVER_NS, side="right")
    last = np.searchsorted(seen_ns, times_ns, side="right")
    sets = [frozenset(cameras[a:b].tolist()) for a, b in zip(first.tolist(), last.tolist(), strict=True)]
    newest = [cameras[max(b - 1, 0)] for b in last.tolist()]
    pairs = range(len(times_ns) - 1)
    handed_over = np.array([sets[n] != sets[n + 1] for n in pairs], dtype=bool)
    return handed_over, np.array([newest[n] != newest[n + 1] for n in pairs], dtype=bool)


def summarize_labs(labs: Sequence[LabErrors]) -> Figures:
    """Return the figures of a contender: medians over labs, or percentiles over all labs and robots."""

    def median(values: Sequence[float]) -> float:
        return float(np.median(values))

    def pooled(values: Sequence[Array], share: float = 95.0) -> float:
        everything = np.concatenate(values)
        known = everything[np.isfinite(everything)]
        return float(np.percentile(known, share)) if len(known) else float("nan")

    figures = {
        "mean_mm": median([float(lab.error_2d_mm.mean()) for lab in labs]),
        "p95_mm": median([np.percentile(lab.error_2d_mm, 95) for lab in labs]),
        "median_3d_mm": median([np.median(lab.error_3d_mm) for lab in labs]),
        "p95_3d_mm": median([np.percentile(lab.error_3d_mm, 95) for lab in labs]),
        "ratio": median([float(lab.error_2d_mm.mean()) / lab.single_mm for lab in labs]),
        "single_mm": median([lab.single_mm for lab in labs]),
        "grid_mm": median([float(np.nanmean(lab.grid_mm)) for lab in labs]),
        "grid_p95_mm": median([np.nanpercentile(lab.grid_mm, 95) for lab in labs]),
        "hand_over_mm": pooled([lab.hand_over_mm for lab in labs]),
        "other_camera_mm": pooled([lab.other_camera_mm for lab in labs]),
        "velocity_m_s": pooled([lab.velocity_m_s for lab in labs]),
        "heading_mean_deg": median([float(np.nanmean(lab.heading_deg)) for lab in labs]),
        "heading_p95_deg": median([np.nanpercentile(lab.heading_deg, 95) for lab in labs]),
    }
    for name in ("at_rows", "between", "coasting"):
        figures |= {f"{name}_{key}": value for key, value in _coverage([getattr(lab, name) for lab in labs])}
    return figures


def _coverage(labs: Sequence[tuple[Array, Array]]) -> list[tuple[str, float]]:
    """Return the mean shares inside the 68 and 95 % regions over labs, in %, and the NEES."""
    shares = []
    for errors_m, covariances_m2 in labs:
        known = np.isfinite(covariances_m2).all(axis=(1, 2)) & np.isfinite(errors_m).all(axis=1)
        if known.any():
            shares.append(region_shares(errors_m[known], covariances_m2[known]))
    if not shares:
        return []
    return [
        ("68", 100 * float(np.mean([one.inside_68 for one in shares]))),
        ("95", 100 * float(np.mean([one.inside_95 for one in shares]))),
        ("nees", float(np.mean([one.nees for one in shares]))),
    ]
