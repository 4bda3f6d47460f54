"""Robots that stop and start again on the path of a simulated drive, and their exact velocities."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ipsys_log.capture.simulation.drive import START_S, Drive, eased_s
from ipsys_log.messages import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Stops:
    """The stops of a robot.

    Attributes
    ----------
    legs_s, stands_s : mean durations of a leg and of a stand, above 0; they have exponential distributions.
    acceleration_m_s2 : of each start, and of each braking, above 0.
    """

    legs_s: float
    stands_s: float
    acceleration_m_s2: float


@dataclass(frozen=True, slots=True, eq=False)
class Pace:
    """The speed of a robot, as a share of full speed: linear between knots, constant after the last one.

    Attributes
    ----------
    times_s : (n,), of the knots, from 0 on.
    shares : (n,), of full speed, at the knots.
    """

    times_s: Array
    shares: Array

    def share_at(self, times_s: Array) -> Array:
        """Return the shares of full speed (n,) at times (n,)."""
        return np.interp(times_s, self.times_s, self.shares)

    def driven_s(self, times_s: Array) -> Array:
        """Return the ways since the start (n,) at times (n,), as the time for them at full speed."""
        steps_s = np.diff(self.times_s)
        ends_s = np.concatenate([[0.0], np.cumsum(steps_s * (self.shares[1:] + self.shares[:-1]) / 2)])
        knot = np.maximum(np.searchsorted(self.times_s, times_s, side="right") - 1, 0)
        since_s = times_s - self.times_s[knot]
        return np.asarray(ends_s[knot] + since_s * (self.shares[knot] + self.share_at(times_s)) / 2)


def draw_pace(stops: Stops, speed_m_s: float, duration_s: float, rng: np.random.Generator) -> Pace:
    """Draw the pace of a robot: it drives at full speed at the start, and stops again and again.

    Parameters
    ----------
    stops : its stops.
    speed_m_s : its full speed.
    duration_s : the drive has stops until this time.
    rng : random numbers.

    Examples
    --------
    >>> stops = Stops(legs_s=6.0, stands_s=2.0, acceleration_m_s2=2.5)
    >>> pace = draw_pace(stops, 0.26, 600.0, np.random.default_rng(0))
    >>> round(float(pace.driven_s(np.array([600.0]))[0] / 600), 2)
    0.76
    """
    ramp_s, knots = speed_m_s / stops.acceleration_m_s2, [(0.0, 1.0)]
    time_s = rng.exponential(stops.legs_s)
    while time_s < duration_s:
        stands_s = rng.exponential(stops.stands_s)
        knots += [(time_s, 1.0), (time_s + ramp_s, 0.0)]
        knots += [(time_s + ramp_s + stands_s, 0.0), (time_s + 2 * ramp_s + stands_s, 1.0)]
        time_s += 2 * ramp_s + stands_s + rng.exponential(stops.legs_s)
    times_s, shares = np.array(knots).T
    return Pace(times_s, shares)


@dataclass(frozen=True, slots=True, eq=False)
class PacedDrive(Drive):
    """A drive whose markers in ``paces`` do not drive at full speed all the time, and can meet others."""

    paces: Mapping[int, Pace] = field(default_factory=dict)

    def way_s(self, marker_id: int, times_s: Array) -> Array:
        """Return the way of one marker since the start of the path (n,), as the time for it at full speed."""
        if marker_id not in self.paces:
            return Drive.way_s(self, marker_id, times_s)
        return np.asarray(self.ahead_s[marker_id] + self.paces[marker_id].driven_s(eased_s(times_s)))


def pace_drive(drive: Drive, paces: Mapping[int, Pace]) -> PacedDrive:
    """Return a drive with paces for some of its markers."""
    return PacedDrive(drive.height_m, drive.path, drive.ahead_s, drive.times_s, drive.phases_rad, paces)


def velocities_over(drive: Drive, marker_id: int, times_s: Array) -> Array:
    """Return the exact velocities of one marker at times (n,) after the start: (n, 2), in m/s."""
    since_s = np.maximum(times_s, 0.0)
    way_s = drive.way_s(marker_id, since_s) % drive.times_s[-1]
    interval = np.clip(np.searchsorted(drive.times_s, way_s, side="right"), 1, len(drive.times_s) - 1) - 1
    by_way = (np.diff(drive.phases_rad) / np.diff(drive.times_s))[interval]
    # The robot accelerates: its way on the path grows by this share of the time.
    share = np.where(times_s > 0, 1 - np.exp(-since_s / START_S), 0.0)
    if isinstance(drive, PacedDrive) and marker_id in drive.paces:
        share = share * drive.paces[marker_id].share_at(eased_s(times_s))
    _, (dx, dy) = drive.follow(marker_id, since_s)
    return np.asarray(np.stack([dx, dy], axis=1) * (by_way * share)[:, None])
