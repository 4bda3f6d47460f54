"""The recent sightings of one robot in order of time, and the growth of its covariance without them."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from math import hypot
from typing import NamedTuple

import numpy as np

from ipsys_log.messages import Array
from ipsys_log.models.tracking.filter import Sightings, States
from ipsys_log.models.tracking.motion import MotionNoise, displacement
from ipsys_log.units import NS_PER_S

# A sighting that is older than the newest one by more than this is left out.
HISTORY_NS = NS_PER_S // 2
# More instants than this are checked for those that no late sighting can reach.
_MOST_ROWS = 256
_SLACK_NS = HISTORY_NS // 5
# A camera, and whether the position is inside the calibrated volume.
Seen = tuple[str, bool | None]


class Sighted(NamedTuple):
    """An accepted sighting: a row of the sightings of a message.

    ``inside`` is the flag of the position, see :class:`ipsys_log.messages.Position`.
    """

    time_ns: int
    camera: str
    inside: bool | None
    sightings: Sightings
    sighting: int


class Record(NamedTuple):
    """An accepted sighting, and the state after it: one row each of the arrays of a message.

    ``inside`` is the flag of the position, see :class:`ipsys_log.messages.Position`.
    """

    time_ns: int
    camera: str
    inside: bool | None
    sightings: Sightings
    sighting: int
    states: States
    state: int

    @property
    def sighted(self) -> Sighted:
        """The sighting without the state."""
        return Sighted(self.time_ns, self.camera, self.inside, self.sightings, self.sighting)


@dataclass(slots=True)
class History:
    """The records of one robot, for as long as a late sighting can change them.

    ``times_ns`` are the times of the records, and ``rows_ns`` the instants of the poses that were given out.
    ``began_ns`` is the time of the first record. ``last_ns`` has the time of the last sighting by each camera
    with each flag. A ``complete`` history keeps the ``older`` sightings without their states, for processing
    after the recording.
    """

    records: list[Record] = field(default_factory=list)
    times_ns: list[int] = field(default_factory=list)
    rows_ns: set[int] = field(default_factory=set)
    complete: bool = False
    began_ns: int = 0
    last_ns: dict[Seen, int] = field(default_factory=dict)
    older: list[Sighted] = field(default_factory=list)

    @property
    def newest(self) -> Record:
        """The record with the latest time."""
        return self.records[-1]

    def place_of(self, time_ns: int) -> int:
        """Return the number of records at or before a time; those of the same time come first."""
        return bisect_right(self.times_ns, time_ns)

    def append(self, record: Record) -> None:
        """Add a record after the others, and forget those that no late sighting can reach."""
        if not self.records:
            self.began_ns = record.time_ns
        self.records.append(record)
        self.times_ns.append(record.time_ns)
        self.last_ns[record.camera, record.inside] = record.time_ns
        self._forget()

    def replace_from(self, place: int, records: list[Record]) -> None:
        """Replace the records from a place on, and forget those that no late sighting can reach."""
        self.began_ns = min(self.began_ns, records[0].time_ns)
        self.records[place:] = records
        self.times_ns[place:] = [record.time_ns for record in records]
        for record in records:
            seen = record.camera, record.inside
            self.last_ns[seen] = max(self.last_ns.get(seen, 0), record.time_ns)
        self._forget()

    def _forget(self) -> None:
        oldest_ns = self.times_ns[-1] - HISTORY_NS
        if self.times_ns[0] > oldest_ns - _SLACK_NS:  # mostly: several records are forgotten together
            return
        # The last record before the oldest time stays: a sighting at that time starts from it.
        forgotten = max(bisect_right(self.times_ns, oldest_ns) - 1, 0)
        if forgotten:
            if self.complete:
                self.older += [record.sighted for record in self.records[:forgotten]]
            del self.records[:forgotten], self.times_ns[:forgotten]
        if len(self.rows_ns) > _MOST_ROWS:
            self.rows_ns = {time_ns for time_ns in self.rows_ns if time_ns >= oldest_ns}

    def everything(self) -> list[Sighted]:
        """Return all sightings in order of time; of a ``complete`` history."""
        return [*self.older, *(record.sighted for record in self.records)]

    def recent(self, time_ns: int, window_ns: int) -> tuple[Record, tuple[str, ...], bool | None]:
        """Return the last record of a window that ends at a time, and the sightings of the window, combined.

        Parameters
        ----------
        time_ns : of a record.
        window_ns : at most :data:`HISTORY_NS`.
        """
        first_ns, newest = time_ns - window_ns, self.records[-1]
        if newest.time_ns == time_ns:  # mostly
            seen = tuple([one for one, last_ns in self.last_ns.items() if last_ns >= first_ns])
            return newest, *combine_seen(seen)
        records = self.records[bisect_left(self.times_ns, first_ns) : self.place_of(time_ns)]
        return records[-1], *combine_seen(tuple((one.camera, one.inside) for one in records))


@lru_cache(maxsize=1024)  # robots have few combinations of cameras, again and again
def combine_seen(seen: tuple[Seen, ...]) -> tuple[tuple[str, ...], bool | None]:
    """Return the cameras of sightings, sorted, and whether one of them is inside; None if no camera tells."""
    flags = [inside for _, inside in seen if inside is not None]
    return tuple(sorted({camera for camera, _ in seen})), any(flags) if flags else None


def gather_states(records: Sequence[Record]) -> States:
    """Return the states of records of different messages together."""
    states = records[0].states
    if all(record.states is states for record in records):
        return states.take(np.array([record.state for record in records]))
    return States(
        np.array([record.states.means[record.state] for record in records]),
        np.array([record.states.covariances[record.state] for record in records]),
        np.array([record.states.cross[record.state] for record in records]),
        states.fade_m,
        _stacked(record.states.turns[record.state] for record in records if record.states.turns is not None),
    )


def gather_sightings(records: Sequence[Record | Sighted]) -> Sightings:
    """Return the sightings of records of different messages together."""
    return Sightings(
        np.array([record.sightings.poses[record.sighting] for record in records]),
        np.array([record.sightings.noise[record.sighting] for record in records]),
        np.array([record.sightings.sensitivities[record.sighting] for record in records]),
        np.array([record.sightings.clock_s[record.sighting] for record in records]),
        _stacked(one.sightings.turns[one.sighting] for one in records if one.sightings.turns is not None),
        _stacked(
            one.sightings.by_rates[one.sighting] for one in records if one.sightings.by_rates is not None
        ),
    )


def _stacked(parts: Iterable[Array]) -> Array | None:
    """Return the matrices of free bodies as one array; None without any, for level robots."""
    together = list(parts)
    return np.array(together) if together else None


# A prediction of this duration is compared
_AHEAD_NS = 400_000_000
# every 0.1 s with the robot's position.
_EVERY_NS = 100_000_000
# Comparisons that the usual motion counts for.
_PRIOR = 15
# Comparisons after which the weight of an old one is 1 / e.
_MEMORY = 300
# Limits of the growth.
_LEAST = 0.1
_LARGEST = 10.0


@dataclass(slots=True)
class UnseenGrowth:
    """The growth of the covariance of one robot without sightings, in units of that by the usual motion.

    The state 0.4 s ago predicts the position of now. The squared error of the prediction, in units of the
    growth of its variance, is one comparison. The scale is the mean of all comparisons, old ones with less
    weight, and of the usual motion. The usual motion counts like about 3 s of driving.

    Attributes
    ----------
    weight, total : sum of the weights of the comparisons, and of their weighted squared errors.
    due_ns : earliest time of the next comparison.
    """

    weight: float = 0.0
    total: float = 0.0
    due_ns: int = 0

    @property
    def scale(self) -> float:
        """The scale of variances; it is between 0.1 and 10."""
        return min(max((_PRIOR + self.total) / (_PRIOR + self.weight), _LEAST), _LARGEST)

    def learn(self, history: History, noise: MotionNoise) -> None:
        """Compare the newest position of a history with its prediction, if the history is long enough.

        A comparison has the weight of the accelerations in the variance of the prediction: a new track, whose
        velocity is not known, tells nothing about them.

        Parameters
        ----------
        history : of the robot.
        noise : the usual motion.
        """
        newest = history.newest
        place = history.place_of(newest.time_ns - _AHEAD_NS)
        if not place:
            return
        before = history.records[place - 1]
        mean, layout = before.states.means[before.state].tolist(), before.states.layout
        rate, change = layout.columns, 2 * layout.columns
        (x_m, y_m), (vx_m_s, vy_m_s) = mean[:2], mean[rate : rate + 2]
        ax_m_s2, ay_m_s2 = mean[change : change + 2]
        now_x_m, now_y_m = newest.states.means[newest.state, :2].tolist()
        ahead_s = (newest.time_ns - before.time_ns) / NS_PER_S
        far_m, unit_m2 = displacement(ahead_s, noise.hold_s)
        missed_m = hypot(
            now_x_m - x_m - vx_m_s * ahead_s - ax_m_s2 * far_m,
            now_y_m - y_m - vy_m_s * ahead_s - ay_m_s2 * far_m,
        )
        # Both axes: the accelerations, and the errors of the velocity and of the acceleration.
        own_m2 = 2 * unit_m2 * (noise.acceleration_m_s2**2 + (noise.bend_rad_s * hypot(vx_m_s, vy_m_s)) ** 2)
        known = before.states.covariances[before.state].item
        growth_m2 = own_m2 + sum(
            ahead_s**2 * known(rate + axis, rate + axis)
            + 2 * ahead_s * far_m * known(rate + axis, change + axis)
            + far_m**2 * known(change + axis, change + axis)
            for axis in (0, 1)
        )
        kept, weight = 1 - 1 / _MEMORY, own_m2 / growth_m2
        self.weight = kept * self.weight + weight
        self.total = kept * self.total + weight * missed_m**2 / growth_m2
        self.due_ns = newest.time_ns + _EVERY_NS
