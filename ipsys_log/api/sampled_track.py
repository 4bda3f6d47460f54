"""Poses of a robot of a log at any times."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.provenance import newest_run
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array
from ipsys_log.messages.channels import SMOOTHED_TRACKS, TRACKS, Channel
from ipsys_log.models.tracking.track_messages import gather_rows, interpolate

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True, eq=False)
class SampledTrack:
    """Poses of one robot at k times; NaN outside of its tracks, and for missing values.

    Attributes
    ----------
    robot, run, channel : its name, and the run and the channel with its tracks.
    times_ns : (k,).
    points_m, velocities_m_s : (k, 3), in the world.
    covariances_m2 : (k, 3, 3), of the points.
    headings_rad, heading_sigmas_rad, turn_rates_rad_s : (k,).
    """

    robot: str
    run: str
    channel: str
    times_ns: NDArray[np.int64]
    points_m: Array
    covariances_m2: Array
    velocities_m_s: Array
    headings_rad: Array
    heading_sigmas_rad: Array
    turn_rates_rad_s: Array

    def __repr__(self) -> str:
        return f"<SampledTrack of {self.robot}: {len(self.times_ns)} times, {self.channel} of run {self.run}>"

    def __len__(self) -> int:
        return len(self.times_ns)

    def to_frame(self) -> pd.DataFrame:
        """Return a pandas table with a row for each time, in UTC, and the names of the table of tracks."""
        from ipsys_log.exchange.data_frames import import_pandas

        pandas = import_pandas()
        columns: dict[str, Any] = {"time": pandas.to_datetime(self.times_ns, utc=True)}
        columns |= {f"{axis}_m": self.points_m[:, n] for n, axis in enumerate("xyz")}
        columns |= {f"v{axis}_m_s": self.velocities_m_s[:, n] for n, axis in enumerate("xyz")}
        columns |= {
            f"cov_{'xyz'[i]}{'xyz'[j]}_m2": self.covariances_m2[:, i, j]
            for i in range(3)
            for j in range(i, 3)
        }
        columns["heading_rad"] = self.headings_rad
        columns["heading_sigma_rad"] = self.heading_sigmas_rad
        columns["turn_rate_rad_s"] = self.turn_rates_rad_s
        table: pd.DataFrame = pandas.DataFrame(columns)
        return table


def sample_track(session: Session, robot: str, times: Any, run: str | None) -> SampledTrack:
    """Return the poses of a robot, from smoothed tracks if the log has them, otherwise from tracks.

    Raises
    ------
    IpsysError
        There is no such robot or run, or a time is not valid.
    """
    channel, name = _source(session, run)
    rows, robots = gather_rows(session.messages(session.topics(channel, name)), robot)
    if robot not in robots:
        raise IpsysError(
            f"{session}: run {name} has no robot {robot!r}; it has {', '.join(sorted(robots)) or 'none'}"
        )
    times_ns = times_in_ns(times)
    samples = interpolate(rows, times_ns)
    return SampledTrack(
        robot,
        name,
        channel.name,
        times_ns,
        samples.points_m,
        samples.covariances_m2,
        samples.velocities_m_s,
        samples.headings_rad,
        samples.heading_sigmas_rad,
        samples.turn_rates_rad_s,
    )


def _source(session: Session, run: str | None) -> tuple[Channel, str]:
    """Return the channel and the run to read: smoothed tracks of a run before its tracks."""
    if run is None:
        run = newest_run(session, TRACKS) or newest_run(session, SMOOTHED_TRACKS)
    for channel in (SMOOTHED_TRACKS, TRACKS):
        if run is not None and session.topics(channel, run):
            return channel, run
    known = sorted(name for name in session.run_names() if session.topics(TRACKS, name))
    wanted = f"run {run} has no tracks" if run else "no run has tracks"
    raise IpsysError(
        f"{session}: {wanted} (they are in: {', '.join(known) or 'none'}); "
        "run: ipsys replay LOG --until smooth"
    )


def times_in_ns(times: Any) -> NDArray[np.int64]:
    """Return times as integers in ns, (k,).

    Parameters
    ----------
    times : integers in ns, datetimes with a time zone, a pandas index or column of these, or numpy's
        ``datetime64``, which is in UTC; one or several.

    Raises
    ------
    IpsysError
        A time has no time zone, or is something else.
    """
    if isinstance(times, int | np.integer | datetime):
        times = [times]
    zone_of = getattr(times, "dt", times)  # a column of pandas has it there, an index itself
    values = np.asarray(times)
    if values.dtype.kind == "M":
        if hasattr(zone_of, "tz") and zone_of.tz is None:
            raise IpsysError("the times have no time zone; give one, for example .tz_localize('UTC')")
        return values.reshape(-1).astype("datetime64[ns]").astype(np.int64)
    if values.dtype.kind in "iu" or not values.size:
        return values.reshape(-1).astype(np.int64)
    return np.array([_one_in_ns(time) for time in values.reshape(-1).tolist()], dtype=np.int64)


def _one_in_ns(time: object) -> int:
    nanoseconds = getattr(time, "value", None)  # of a pandas time stamp, which has more digits
    if isinstance(time, datetime):
        exact_ns = time_in_ns(time)
        return nanoseconds if isinstance(nanoseconds, int) else exact_ns
    if isinstance(time, int):
        return time
    raise IpsysError(f"{time!r} is not a time; give integers in ns, or datetimes with a time zone")


def time_in_ns(time: datetime) -> int:
    """Return a datetime with a time zone as an integer in ns.

    Raises
    ------
    IpsysError
        It has no time zone.
    """
    if time.tzinfo is None:
        raise IpsysError(f"{time}: has no time zone; give one, for example datetime.now(timezone.utc)")
    whole = int(time.replace(microsecond=0).timestamp())
    return whole * 1_000_000_000 + time.microsecond * 1_000
