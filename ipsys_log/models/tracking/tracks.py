"""Tracks of robots from the sightings of all cameras, in the order in which they arrive."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array
from ipsys_log.models.tracking.filter import Innovations, Sightings, States, compare, predict, start, update
from ipsys_log.models.tracking.history import (
    HISTORY_NS,
    History,
    Record,
    UnseenGrowth,
    gather_sightings,
    gather_states,
)
from ipsys_log.models.tracking.motion import FREE_MOTION, MotionNoise
from ipsys_log.units import NS_PER_S

# The name of a robot, and the id of its reference marker.
Robot = tuple[str, int]

_ONE = np.zeros(1, dtype=np.intp)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackSettings:
    """Limits of tracks.

    Attributes
    ----------
    motion : the usual motion of a robot.
    gate : largest squared difference of a sighting from its prediction, in units of its covariance; 30 is
        exceeded by chance once in 200,000 sightings.
    slack_m, slack_rad : errors that the covariances do not contain; they widen the gate.
    restart : a track starts again after this number of consecutive sightings that contradict it and agree
        with one another, or are too late. A younger track starts again after as many as it has itself.
    gap_ns : a robot that is unseen for longer is coasting. A track with fewer sightings than ``restart``
        does not: its velocity is not certain.
    coast_ns : a track ends when its robot is unseen for longer.
    coast_m : a prediction with a larger standard deviation is left out, as in a track of one sighting.
    window_ns : the cameras of a pose are those of the sightings in this time.
    """

    motion: MotionNoise = field(default_factory=MotionNoise)
    gate: float = 30.0
    slack_m: float = 0.003
    slack_rad: float = 0.02
    restart: int = 3
    gap_ns: int = NS_PER_S // 10
    coast_ns: int = NS_PER_S
    coast_m: float = 0.6
    window_ns: int = NS_PER_S // 10


FREE_BODIES = TrackSettings(motion=FREE_MOTION)


class Pose(NamedTuple):
    """The pose of one robot at one instant: a row of ``states``.

    Its covariance means nothing without ``has_covariance``: the position has none.

    ``cameras`` are those of the recent sightings, ``newest`` the last sighting; ``coasting_ns`` is the time
    since then if the robot is unseen, otherwise None.
    """

    robot: Robot
    time_ns: int
    states: States
    state: int
    cameras: tuple[str, ...]
    inside: bool | None
    has_covariance: bool
    coasting_ns: int | None = None
    age_ns: int | None = None


@dataclass(slots=True)
class _Track:
    """A track, and the sightings that contradict it: a rival track of the same robot.

    ``growth`` is that of its covariance without sightings. ``sightings`` counts those of the track, ``hits``
    the consecutive ones of the rival, and ``late`` those that are too late.
    """

    history: History
    growth: UnseenGrowth = field(default_factory=UnseenGrowth)
    sightings: int = 0
    has_covariance: bool = True
    rival: History | None = None
    hits: int = 0
    late: int = 0


@dataclass(slots=True)
class _Batch:
    """The sightings of one message that are filtered together, by their row in the message."""

    camera: str
    sightings: Sightings
    times_ns: Sequence[int]
    inside: Sequence[bool | None]
    has_covariance: Sequence[bool]


class RobotTracks:
    """The tracks of all robots.

    Every sighting updates the track of its robot at its own capture time. A late sighting is filtered again
    with all later ones, up to `HISTORY_NS` in ``history.py``. Poses that were given out
    stay as they are.

    A sighting outside the gate changes nothing. If several of them agree with one another, and none agrees
    with the track, the track starts again with them.

    Parameters
    ----------
    settings : the limits of tracks.
    fade_m : (m,), of the amplitudes of the calibration, see `States` in ``filter.py``.
    complete : keep all sightings of all tracks, without their states, for their smoothing.
    """

    def __init__(
        self, settings: TrackSettings | None = None, fade_m: Array | None = None, complete: bool = False
    ) -> None:
        self._settings, self._fade_m = settings or TrackSettings(), fade_m
        self._slack = np.array([self._settings.slack_m**2] * 3 + [self._settings.slack_rad**2] * 3)
        self._complete = complete
        self._tracks: dict[Robot, _Track] = {}
        # Instants at which another frame may still show a robot.
        self._instants_ns: set[int] = set()
        self._ended: list[tuple[Robot, History]] = []

    def histories(self) -> list[tuple[Robot, History]]:
        """Return all tracks with their robots, ended ones first; only if the histories are ``complete``."""
        return [*self._ended, *((robot, track.history) for robot, track in self._tracks.items())]

    def observe(
        self,
        camera: str,
        robots: Sequence[Robot],
        times_ns: Sequence[int],
        sightings: Sightings,
        inside: Sequence[bool | None],
        has_covariance: Sequence[bool],
    ) -> list[Pose]:
        """Update the tracks with the sightings of one message.

        Parameters
        ----------
        camera : its name.
        robots : (k,), one sighting of each robot.
        times_ns : (k,), capture times.
        sightings : (k,).
        inside : (k,), flags of the positions.
        has_covariance : (k,), False for a position whose covariance is unknown.

        Returns
        -------
        The poses at the instants of the sightings. An instant of a robot that already has a pose gets none.
        """
        batch = _Batch(camera, sightings, times_ns, inside, has_covariance)
        # A frame can show the same marker twice: one sighting of each robot after the other.
        poses, waiting = [], list(range(len(robots)))
        while waiting:
            first = {robots[row]: row for row in reversed(waiting)}
            poses += self._observe(batch, robots, sorted(first.values()))
            waiting = [row for row in waiting if first[robots[row]] != row]
        return poses

    def coast_before(self, time_ns: int) -> list[Pose]:
        """Return the predicted poses at the instants of earlier frames; a frame of this instant has arrived.

        Synchronised cameras have frames of one instant: a robot that one of them does not see is predicted
        only after all of them.
        """
        due_ns = sorted(own_ns for own_ns in self._instants_ns if own_ns < time_ns)
        self._instants_ns = {time_ns, *self._instants_ns}.difference(due_ns)
        return [pose for own_ns in due_ns for pose in self.coast(own_ns)]

    def coast(self, time_ns: int) -> list[Pose]:
        """Return the predicted poses of unseen robots at an instant, and end the tracks that are too old."""
        settings, coasting = self._settings, []
        for robot, track in list(self._tracks.items()):
            age_ns = time_ns - track.history.newest.time_ns
            if age_ns > settings.coast_ns:
                self._end(robot, track.history)
                del self._tracks[robot]
            elif age_ns > settings.gap_ns and self._can_coast(track) and time_ns not in track.history.rows_ns:
                coasting.append((robot, track, age_ns))
        if not coasting:
            return []
        last = gather_states([track.history.newest for _, track, _ in coasting])
        ages_s = np.array([age_ns for _, _, age_ns in coasting]) / NS_PER_S
        scales = np.array([track.growth.scale for _, track, _ in coasting])
        states = predict(last, ages_s, settings.motion, scales)
        spreads_m2 = states.covariances[:, :2, :2].diagonal(axis1=1, axis2=2).max(axis=1)
        for _, track, _ in coasting:
            track.history.rows_ns.add(time_ns)
        return [
            Pose(
                robot,
                time_ns,
                states,
                row,
                (),
                track.history.newest.inside,
                track.has_covariance,
                age_ns,
                time_ns - track.history.began_ns,
            )
            for row, (robot, track, age_ns) in enumerate(coasting)
            if spreads_m2[row] < settings.coast_m**2
        ]

    def _can_coast(self, track: _Track) -> bool:
        """Return whether the velocity is known, and the robot is not seen at another place."""
        return track.rival is None and track.sightings >= self._settings.restart

    def _observe(self, batch: _Batch, robots: Sequence[Robot], all_rows: list[int]) -> list[Pose]:
        rows, tracks, places = [], [], []
        for row in all_rows:
            time_ns = batch.times_ns[row]
            track = self._track_of(robots[row], time_ns)
            if track is not None:
                rows.append(row)
                tracks.append(track)
                places.append(track.history.place_of(time_ns) if track.history.records else 0)
        if not rows:
            return []
        accepted = self._filter(batch, robots, np.array(rows), tracks, places)
        return [
            pose
            for row, track, is_accepted in zip(rows, tracks, accepted, strict=True)
            if is_accepted and (pose := self._pose(robots[row], track, batch, row))
        ]

    def _track_of(self, robot: Robot, time_ns: int) -> _Track | None:
        """Return the track for a sighting, a new one if there is none; None for a sighting that is too late.

        After a sighting with a time in the future, all others are too late: then the track starts again.
        """
        track = self._tracks.get(robot)
        if track is not None and time_ns < track.history.newest.time_ns - HISTORY_NS:
            track.late += 1
            if track.late < self._settings.restart:
                return None
        elif track is not None and time_ns - track.history.newest.time_ns <= self._settings.coast_ns:
            return track
        if track is not None:
            self._end(robot, track.history)
        track = self._tracks[robot] = _Track(History(complete=self._complete))
        return track

    def _end(self, robot: Robot, history: History) -> None:
        if self._complete:
            self._ended.append((robot, history))

    def _filter(
        self,
        batch: _Batch,
        robots: Sequence[Robot],
        rows: NDArray[np.intp],
        tracks: list[_Track],
        places: list[int],
    ) -> list[bool]:
        """Filter the sightings of some rows, and the later ones again; return which rows are accepted."""
        states, mask = self._states_after(batch, rows, tracks, places)
        accepted: list[bool] = mask.tolist()
        later = []
        for number, (row, track, place) in enumerate(zip(rows.tolist(), tracks, places, strict=True)):
            record = Record(
                batch.times_ns[row], batch.camera, batch.inside[row], batch.sightings, row, states, number
            )
            if not accepted[number]:
                accepted[number] = self._contradict(robots[row], track, record)
                continue
            track.rival, track.hits, track.late = None, 0, 0
            track.sightings += 1
            if place < len(track.history.records):
                later.append((track, place, [record, *track.history.records[place:]]))
                continue
            track.history.append(record)
            track.has_covariance = batch.has_covariance[row]
            if record.time_ns >= track.growth.due_ns:
                track.growth.learn(track.history, self._settings.motion)
        self._filter_again(later)
        return accepted

    def _states_after(
        self, batch: _Batch, rows: NDArray[np.intp], tracks: list[_Track], places: list[int]
    ) -> tuple[States, NDArray[np.bool_]]:
        """Return the states after sightings, and a mask of those within the gate; new tracks have no gate."""
        known = np.flatnonzero(places)
        states, accepted = None, np.ones(len(rows), dtype=bool)
        if len(known) < len(rows):
            states = start(batch.sightings.take(rows), self._settings.motion, self._fade_m)
        if len(known):
            before = [tracks[n].history.records[places[n] - 1] for n in known.tolist()]
            rows = rows[known]
            predicted = self._predicted(before, [batch.times_ns[row] for row in rows.tolist()])
            sightings = batch.sightings.take(rows)
            innovations = compare(predicted, sightings)
            accepted[known] = self._agrees(innovations)
            after = update(predicted, sightings, innovations)
            states = after if states is None else states.replace(known, after)
        assert states is not None
        return states, accepted

    def _filter_again(self, changed: list[tuple[_Track, int, list[Record]]]) -> None:
        """Filter the records after the first of each list again, and put the lists into the histories."""
        step = 1
        while waiting := [records for _, _, records in changed if len(records) > step]:
            predicted = self._predicted(
                [records[step - 1] for records in waiting], [records[step].time_ns for records in waiting]
            )
            seen = gather_sightings([records[step] for records in waiting])
            states = update(predicted, seen, compare(predicted, seen))
            for row, records in enumerate(waiting):
                records[step] = records[step]._replace(states=states, state=row)
            step += 1
        for track, place, records in changed:
            track.history.replace_from(place, records)

    def _predicted(self, before: Sequence[Record], times_ns: Sequence[int]) -> States:
        durations_s = np.array([t - r.time_ns for t, r in zip(times_ns, before, strict=True)]) / NS_PER_S
        return predict(gather_states(before), durations_s, self._settings.motion)

    def _agrees(self, innovations: Innovations) -> NDArray[np.bool_]:
        """Return a mask (k,) of the sightings within the gate."""
        slack = np.diag(self._slack[: innovations.differences.shape[1]])
        return np.asarray(innovations.chi2(slack) < self._settings.gate)

    def _contradict(self, robot: Robot, track: _Track, record: Record) -> bool:
        """Add a sighting outside the gate to the rival; return whether the track starts again with it."""
        seen, rival = record.sightings.take(_ONE + record.sighting), track.rival
        states, hits = start(seen, self._settings.motion, self._fade_m), 1
        if rival is not None and rival.newest.time_ns <= record.time_ns:
            predicted = self._predicted([rival.newest], [record.time_ns])
            innovations = compare(predicted, seen)
            if self._agrees(innovations)[0]:
                states, hits = update(predicted, seen, innovations), track.hits + 1
        own = record._replace(states=states, state=0)
        if hits == 1 or rival is None:
            rival = History(complete=self._complete)
        rival.append(own)
        track.rival, track.hits = rival, hits
        if hits < min(self._settings.restart, track.sightings):
            return False
        self._end(robot, track.history)
        rival.rows_ns = track.history.rows_ns
        track.history, track.sightings, track.rival, track.hits = rival, hits, None, 0
        return True

    def _pose(self, robot: Robot, track: _Track, batch: _Batch, row: int) -> Pose | None:
        """Return the pose at the instant of a sighting; None if there is one already."""
        time_ns = batch.times_ns[row]
        if time_ns in track.history.rows_ns:
            return None
        track.history.rows_ns.add(time_ns)
        last, cameras, inside = track.history.recent(time_ns, self._settings.window_ns)
        return Pose(
            robot,
            time_ns,
            last.states,
            last.state,
            cameras,
            inside,
            batch.has_covariance[row],
            age_ns=time_ns - track.history.began_ns,
        )
