"""Statistics of the covariances of tracks over many simulated labs: are they those of the errors?

Each lab is one draw: all errors of a lab share its calibration. The normalised squared error (NEES) of a lab
has a standard deviation of 0.6, so the mean of 20 labs is uncertain by 0.14. Single positions of the same
drive share these errors. So the NEES of a track minus that of the single positions shows the part of the
filter, with a tenth of this uncertainty.

All cameras are covered in the last part of a drive. The filter is causal: the rows before are those of a
drive without a gap, and one run gives all figures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray
from track_contenders import CONTENDERS, RobotTrack
from track_drives import Condition, SeenDrive, calibrate, cover, drive_through

from ipsys_log.units import NS_PER_S
from tests.geometric.floor_error import region_shares

__all__ = ["COVERAGE_DRIVE_S", "coverage_of_lab", "coverage_table"]

Array = NDArray[np.float64]
Times = NDArray[np.int64]
# Errors (n, 2) in m, and covariances (n, 2, 2).
Errors = tuple[Array, Array]
# The shares inside the regions and the NEES, by kind of instant.
LabCoverage = dict[str, dict[str, float]]

# A drive is seen for 2.9 s, and ends with a gap.
COVERAGE_DRIVE_S = 3.5
_GAP_NS, _LEFT_OUT_NS = 600_000_000, 500_000_000
# Half-way instants of rows that are further apart are no instants between captures.
_MOST_GAP_NS = 60_000_000
_SINGLE, _LIVE, _SMOOTHED = "single positions", "fuse", "smooth"


def coverage_of_lab(condition: Condition, calibration: str, seed: int, drive_s: float) -> LabCoverage:
    """Return the coverage of one lab, by kind of instant.

    Parameters
    ----------
    condition : of the drive.
    calibration : its name in ``CALIBRATIONS``.
    seed : of the lab.
    drive_s : duration of the drive in s, with the gap at its end.

    Raises
    ------
    FitError
        The calibration has too few points.
    """
    drive = drive_through(condition, calibrate(condition, calibration, seed), seed, drive_s)
    last_ns = drive.positions[-1].publish_time_ns
    covered = cover(drive, [(last_ns - _GAP_NS, last_ns + NS_PER_S)])
    errors = {_SINGLE: _single_errors(covered)}
    for name in (_LIVE, _SMOOTHED):
        tracks = CONTENDERS[name](covered)
        parts = [_track_errors(covered, robot, track) for robot, track in tracks.items()]
        for kind in parts[0]:
            errors[f"{name}, {kind}"] = _join([part[kind] for part in parts])
    return {kind: asdict(region_shares(*one)) for kind, one in errors.items() if len(one[0])}


def _single_errors(drive: SeenDrive) -> Errors:
    """Return the errors of all single positions of a drive after its first part."""
    begins_ns = {robot: times_ns[0] + _LEFT_OUT_NS for robot, (times_ns, _, _) in drive.sightings.items()}
    errors_m, covariances_m2 = [], []
    for message in drive.positions:
        for one in message.payload.positions:
            time_ns = message.publish_time_ns + (one.time_offset_ns or 0)
            if time_ns >= begins_ns[one.id] and one.covariance_m2 is not None:
                truth_m = drive.truth.poses(one.id, np.array([time_ns]))[0, :2]
                errors_m.append(np.array([one.x_m, one.y_m]) - truth_m)
                covariances_m2.append(one.covariance_m2[:2, :2])
    return np.array(errors_m).reshape(-1, 2), np.array(covariances_m2).reshape(-1, 2, 2)


def _track_errors(drive: SeenDrive, robot: int, track: RobotTrack) -> dict[str, Errors]:
    """Return the errors of a track at captures, half-way between them, and while it is predicted."""
    times_ns = track.times_ns
    later = times_ns >= times_ns[0] + _LEFT_OUT_NS
    seen = np.isin(times_ns, drive.sightings[robot][0])

    def at_rows(rows: NDArray[np.bool_]) -> Errors:
        return track.points_m[rows, :2] - _truth(drive, robot, times_ns[rows]), track.covariances_m2[rows]

    return {
        "at capture": at_rows(later & seen),
        "half-way": _between(drive, robot, track, times_ns[later & seen]),
        "coasting": at_rows(later & ~seen),
    }


def _between(drive: SeenDrive, robot: int, track: RobotTrack, times_ns: Times) -> Errors:
    steps_ns = np.diff(times_ns)
    near = (steps_ns > 1) & (steps_ns <= _MOST_GAP_NS)
    middle_ns = times_ns[:-1][near] + steps_ns[near] // 2
    points_m, covariances_m2 = track.predict(middle_ns)
    return points_m - _truth(drive, robot, middle_ns), covariances_m2


def _truth(drive: SeenDrive, robot: int, times_ns: Times) -> Array:
    return drive.truth.poses(robot, times_ns)[:, :2]


def _join(parts: Sequence[Errors]) -> Errors:
    return np.concatenate([one for one, _ in parts]), np.concatenate([one for _, one in parts])


def coverage_table(title: str, labs: Sequence[Mapping[str, Mapping[str, float]]]) -> str:
    """Return the means over labs with their standard errors, as lines of text.

    The last column has the NEES minus that of the single positions in the same labs.
    """
    lines = [
        f"{title}, {len(labs)} labs",
        f"  {'':<20}{'% in 68 %':>13}{'% in 95 %':>13}{'NEES':>14}{'minus single':>15}",
    ]
    return "\n".join([*lines, *(_row(kind, labs) for kind in _kinds(labs))])


def _kinds(labs: Sequence[Mapping[str, Mapping[str, float]]]) -> Iterator[str]:
    yield from dict.fromkeys(kind for lab in labs for kind in lab)


def _row(kind: str, labs: Sequence[Mapping[str, Mapping[str, float]]]) -> str:
    own = [lab for lab in labs if kind in lab]
    nees = np.array([lab[kind]["nees"] for lab in own])
    inside = ((key, 100 * np.array([lab[kind][key] for lab in own])) for key in ("inside_68", "inside_95"))
    cells = "".join(f"{_with_error(shares, 1):>13}" for _, shares in inside)
    extra = nees - np.array([lab[_SINGLE]["nees"] for lab in own])
    last = "" if kind == _SINGLE else f"{_with_error(extra, 3):>15}"
    return f"  {kind:<20}{cells}{_with_error(nees, 2):>14}{last}"


def _with_error(values: Array, digits: int) -> str:
    mean = f"{values.mean():.{digits}f}"
    if len(values) < 2:
        return mean
    return f"{mean} ± {values.std(ddof=1) / np.sqrt(len(values)):.{digits}f}"
