"""Rows of one robot from messages of tracks, as arrays in order of capture time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.arrays import Array
from ipsys_log.messages import Message, Track
from ipsys_log.tracking.interpolation import TrackRows
from ipsys_log.units import NS_PER_S

# Rows of tracks without an age belong to one track if they are not further apart.
_LONGEST_GAP_NS = NS_PER_S


def gather_rows(messages: Iterable[Message], robot: str) -> tuple[TrackRows, set[str]]:
    """Return the rows of a robot, and the names of all robots.

    Parameters
    ----------
    messages : of one channel and run with tracks, in any order. The last row of an instant counts.
    robot : its name.
    """
    by_time: dict[int, Track] = {}
    names: set[str] = set()
    for message in messages:
        for track in message.payload.tracks:
            names.add(track.robot)
            if track.robot == robot:
                by_time[message.payload.timestamp] = track
    times = sorted(by_time)
    return _rows(np.array(times, dtype=np.int64), [by_time[time_ns] for time_ns in times]), names


def _rows(times_ns: NDArray[np.int64], tracks: Sequence[Track]) -> TrackRows:
    return TrackRows(
        times_ns,
        _numbers(times_ns, tracks),
        np.array([(t.x_m, t.y_m, t.z_m) for t in tracks]).reshape(-1, 3),
        _arrays([t.covariance_m2 for t in tracks], (3, 3)),
        _arrays([t.velocity_m_s for t in tracks], (3,)),
        _arrays([t.velocity_covariance_m2_s2 for t in tracks], (3, 3)),
        _arrays([t.heading_rad for t in tracks], ()),
        _arrays([t.heading_sigma_rad for t in tracks], ()),
        _arrays([t.turn_rate_rad_s for t in tracks], ()),
        _arrays([t.turn_rate_sigma_rad_s for t in tracks], ()),
    )


def _arrays(values: Sequence[Array | float | None], shape: tuple[int, ...]) -> Array:
    """Return values as one array (n, *shape), NaN for missing ones."""
    joined = np.full((len(values), *shape), np.nan)
    for row, value in enumerate(values):
        if value is not None:
            joined[row] = value
    return joined


def _numbers(times_ns: NDArray[np.int64], tracks: Sequence[Track]) -> NDArray[np.int64]:
    """Return the number (n,) of the track of each row: a track began after the row before its first row."""
    numbers = np.zeros(len(tracks), dtype=np.int64)
    for row in range(1, len(tracks)):
        age_ns, gap_ns = tracks[row].age_ns, int(times_ns[row] - times_ns[row - 1])
        begins = gap_ns > _LONGEST_GAP_NS if age_ns is None else age_ns < gap_ns
        numbers[row] = numbers[row - 1] + begins
    return numbers
