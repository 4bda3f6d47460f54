"""Rows of tracks: their messages, late frames, and poses with covariances at any instants between rows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import STAMP_UNRELIABLE, Array, Event, Indices, Message, Model, Rig, Times, Track
from ipsys_log.messages.channels import EVENTS, MODEL, POSITIONS, RIG, Channel
from ipsys_log.messages.stage import StageView
from ipsys_log.models.tracking.motion import MotionNoise, transition
from ipsys_log.models.tracking.tracks import Pose
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import rpy_from_rotation
from ipsys_log.vision.poses import rotation_vector
from ipsys_log.vision.time_brackets import bracket_times

# Columns of the motion in the state: value, rate and acceleration; the last two have white acceleration.
_ON_FLOOR, _UP, _TURN = (0, 4, 8), (2, 6), (3, 7)


@dataclass(frozen=True, slots=True, eq=False)
class TrackRows:
    """The n rows of a robot in order of time; NaN for missing values.

    Attributes
    ----------
    times_ns : (n,), strictly increasing.
    numbers : (n,), number of the track of each row: a robot that was carried away begins a new track.
    points_m, velocities_m_s : (n, 3).
    covariances_m2, velocity_covariances_m2_s2 : (n, 3, 3).
    headings_rad, heading_sigmas_rad, turn_rates_rad_s, turn_rate_sigmas_rad_s : (n,).
    """

    times_ns: Times
    numbers: NDArray[np.int64]
    points_m: Array
    covariances_m2: Array
    velocities_m_s: Array
    velocity_covariances_m2_s2: Array
    headings_rad: Array
    heading_sigmas_rad: Array
    turn_rates_rad_s: Array
    turn_rate_sigmas_rad_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class TrackSamples:
    """Poses at k instants; NaN outside of tracks, and for missing values.

    Attributes
    ----------
    points_m, velocities_m_s : (k, 3).
    covariances_m2 : (k, 3, 3).
    headings_rad, heading_sigmas_rad, turn_rates_rad_s : (k,).
    """

    points_m: Array
    covariances_m2: Array
    velocities_m_s: Array
    headings_rad: Array
    heading_sigmas_rad: Array
    turn_rates_rad_s: Array


def interpolate(rows: TrackRows, times_ns: Times, noise: MotionNoise | None = None) -> TrackSamples:
    """Return the poses of a track at any instants.

    Between two rows, positions and headings are cubic polynomials with the rates of both rows (Hermite): the
    most probable motion with white noise of the acceleration. Without rates, they are linear. The covariance
    has two parts. One is the mixture of the covariances of both rows, because their errors have nearly the
    same causes. The other is the unknown motion between them.

    Parameters
    ----------
    rows : of one robot.
    times_ns : (k,).
    noise : the usual motion of a robot; None: that of the filter.

    Returns
    -------
    TrackSamples : at the instant of a row, those of the row.
    """
    if not len(rows.times_ns):
        return _outside(len(times_ns))
    before, after, _, inside = bracket_times(rows.times_ns, times_ns, np.inf)
    inside &= rows.numbers[before] == rows.numbers[after]
    samples = _between(rows, before, after, times_ns, noise or MotionNoise())
    for one in fields(samples):
        getattr(samples, one.name)[~inside] = np.nan
    return samples


def _outside(count: int) -> TrackSamples:
    vectors, numbers = np.full((count, 3), np.nan), np.full(count, np.nan)
    return TrackSamples(vectors, np.full((count, 3, 3), np.nan), vectors, numbers, numbers, numbers)


def _between(
    rows: TrackRows, before: Indices, after: Indices, times_ns: Times, noise: MotionNoise
) -> TrackSamples:
    """Return the poses between rows ``before`` (k,) and ``after`` (k,)."""
    elapsed_s = (times_ns - rows.times_ns[before]) / NS_PER_S
    whole_s = (rows.times_ns[after] - rows.times_ns[before]) / NS_PER_S
    moving = np.isfinite(rows.velocities_m_s[before] + rows.velocities_m_s[after]).all(axis=1)
    weights = _Weights.of(elapsed_s, whole_s, moving)
    ends_m, rates_m_s = rows.points_m[[before, after]], rows.velocities_m_s[[before, after]]
    points_m, velocities_m_s = weights.mix(ends_m, rates_m_s)
    covariances_m2 = weights.mix_variances(
        rows.covariances_m2[[before, after]], rows.velocity_covariances_m2_s2[[before, after]]
    )
    # The chord between both rows, if they have no velocities.
    speeds_m_s = np.linalg.norm((ends_m[1] - ends_m[0])[:, :2], axis=1) / np.where(whole_s > 0, whole_s, 1.0)
    on_floor_m2, up_m2 = (weights.unknown_motion(columns, speeds_m_s, noise) for columns in (_ON_FLOOR, _UP))
    unknown_m2 = np.stack([on_floor_m2, on_floor_m2, up_m2], axis=1)
    turning = np.isfinite(_rates(rows, before, after)).all(axis=0)
    turns = _Weights.of(elapsed_s, whole_s, turning)
    headings_rad, turn_rates_rad_s = turns.mix(
        _unwrap(rows, before, after, whole_s), _rates(rows, before, after)
    )
    variances_rad2 = turns.mix_variances(
        rows.heading_sigmas_rad[[before, after]] ** 2, rows.turn_rate_sigmas_rad_s[[before, after]] ** 2
    )
    return TrackSamples(
        points_m,
        covariances_m2 + unknown_m2[:, :, None] * np.eye(3),
        velocities_m_s,
        (headings_rad + np.pi) % (2 * np.pi) - np.pi,
        np.sqrt(variances_rad2 + turns.unknown_motion(_TURN, speeds_m_s, noise)),
        turn_rates_rad_s,
    )


def _rates(rows: TrackRows, before: Indices, after: Indices) -> Array:
    return rows.turn_rates_rad_s[[before, after]]


def _unwrap(rows: TrackRows, before: Indices, after: Indices, whole_s: Array) -> Array:
    """Return the headings (2, k) of both rows, the second one without jumps by its turn rate."""
    first, second = rows.headings_rad[[before, after]]
    expected_rad = np.nan_to_num(_rates(rows, before, after).mean(axis=0) * whole_s)
    turned_rad = second - first - expected_rad
    return np.stack([first, first + expected_rad + (turned_rad + np.pi) % (2 * np.pi) - np.pi])


@dataclass(frozen=True, slots=True, eq=False)
class _Weights:
    """Weights (k,) of the values and of the rates of two rows, for a value between them and for its rate.

    ``elapsed_s`` and ``whole_s`` (k,) are the times from the first row to the instant and to the second row.
    """

    elapsed_s: Array
    whole_s: Array
    values: Array
    rates: Array
    slope_values: Array
    slope_rates: Array

    @classmethod
    def of(cls, elapsed_s: Array, whole_s: Array, with_rates: np.bool_ | NDArray[np.bool_]) -> _Weights:
        length_s = np.where(whole_s > 0, whole_s, 1.0)
        u = elapsed_s / length_s
        later = np.where(with_rates, u**2 * (3 - 2 * u), u)
        first, second = length_s * u * (1 - u) ** 2, length_s * u**2 * (u - 1)
        steep = np.where(with_rates, 6 * u * (1 - u), 1.0) / length_s
        return cls(
            elapsed_s,
            whole_s,
            np.stack([1 - later, later]),
            np.where(with_rates, np.stack([first, second]), 0.0),
            np.stack([-steep, steep]),
            np.where(with_rates, np.stack([(1 - u) * (1 - 3 * u), u * (3 * u - 2)]), np.nan),
        )

    def mix(self, values: Array, rates: Array) -> tuple[Array, Array]:
        """Return values (k, ...) and rates (k, ...) from those of both rows, (2, k, ...)."""
        known = np.nan_to_num(rates)
        return (
            _sum(self.values, values) + _sum(self.rates, known),
            _sum(self.slope_values, values) + _sum(self.slope_rates, rates),
        )

    def mix_variances(self, of_values: Array, of_rates: Array) -> Array:
        """Return variances (k, ...) of values from the variances of both rows, (2, k, ...)."""
        return _sum(self.values, of_values) + _sum(self.rates**2, np.nan_to_num(of_rates))

    def unknown_motion(self, columns: tuple[int, ...], speeds_m_s: Array, noise: MotionNoise) -> Array:
        """Return the variance (k,) of the motion between the rows, along some columns of the state.

        The rows are exact. The acceleration of the first row, if it is a column, has its usual deviation.
        """
        own = np.ix_(np.arange(len(speeds_m_s)), np.array(columns), np.array(columns))
        rest_s = np.maximum(self.whole_s - self.elapsed_s, 0.0)
        forward, spread = (one[own] for one in transition(self.elapsed_s, speeds_m_s, noise))
        onward, more = (one[own] for one in transition(rest_s, speeds_m_s, noise))
        if len(columns) == 3:
            usual_m_s2 = np.hypot(noise.acceleration_m_s2, noise.bend_rad_s * speeds_m_s)
            effect = forward[:, :, 2] * usual_m_s2[:, None]
            spread = spread + effect[:, :, None] * effect[:, None]
        cross = spread @ onward.swapaxes(1, 2)
        end = onward @ cross + more
        later = np.stack([self.values[1], self.rates[1]], axis=1)
        shared = (cross[:, 0, :2] * later).sum(axis=1)
        known = (later[:, None] @ end[:, :2, :2] @ later[:, :, None])[:, 0, 0]
        variances: Array = np.maximum(spread[:, 0, 0] - 2 * shared + known, 0.0)
        return variances


def _sum(weights: Array, values: Array) -> Array:
    shape = (2, -1) + (1,) * (values.ndim - 2)
    total: Array = (weights.reshape(shape) * values).sum(axis=0)
    return total


TRACK_READS = (RIG, POSITIONS, MODEL, EVENTS)
# A heading that was never measured has a larger standard deviation.
_UNKNOWN_HEADING_RAD = 2.0
# Rows of tracks without an age belong to one track if they are not further apart.
_LONGEST_GAP_NS = NS_PER_S


def model_of(view: StageView) -> Model | None:
    """Return the model of the positions; None for positions of another program."""
    models = view.payloads(MODEL) if view.run(MODEL) else []
    return models[-1] if models else None


def track_reads(view: StageView) -> tuple[Channel, ...]:
    """Return the channels of ``TRACK_READS`` on which the tracks of a log depend.

    A log without late frames keeps its runs when events are added.
    """
    has_late_frames = any(event.kind == STAMP_UNRELIABLE for event in view.payloads(EVENTS))
    has_model = model_of(view) is not None
    return (RIG, POSITIONS, *([MODEL] if has_model else []), *([EVENTS] if has_late_frames else []))


def tracked_part(rig: Rig, _method: str) -> object:
    """Return the part of the rig on which tracks depend: robots, pivots, and heights of markers."""
    poses = [(m.id, m.robot, m.xyz_m, m.rpy_rad) for m in rig.markers] if rig.bodies else []
    return (
        {(m.id, m.robot, m.height_m, m.height_sigma_m) for m in rig.markers},
        rig.marker_height_m,
        rig.marker_height_sigma_m,
        *((rig.bodies, poses) if rig.bodies else ()),
    )


class LateFrames:
    """The intervals with late frames, by camera. Late frames have wrong times, so tracks leave them out."""

    def __init__(self, events: Iterable[Event] = ()) -> None:
        # By camera and start of an interval, its end; None if there is no end yet.
        self._ends_ns: dict[str, dict[int, int | None]] = defaultdict(dict)
        for event in events:
            self.note(event)

    def note(self, event: Event) -> None:
        """Note the interval of an event; the last event of an interval has its end."""
        if event.kind == STAMP_UNRELIABLE and event.camera is not None and event.start is not None:
            self._ends_ns[event.camera][event.start] = event.end

    def has(self, message: Message) -> bool:
        """Return whether a message comes from a late frame."""
        time_ns = message.publish_time_ns
        return any(
            start_ns <= time_ns and (end_ns is None or time_ns <= end_ns)
            for start_ns, end_ns in self._ends_ns.get(str(message.camera), {}).items()
        )


def make_track(pose: Pose) -> Track:
    """Return the row of a pose; its robot is a pair of the name and the marker id."""
    states, row = pose.states, pose.state
    layout, mean, covariance = states.layout, states.means[row], states.covariances[row]
    robot, marker_id = pose.robot
    x_m, y_m, z_m, heading_rad = mean[:4].tolist()
    rates, heading = layout.columns, layout.columns - 1
    if states.turns is not None:
        heading_rad = rpy_from_rotation(states.turns[row])[2]
    turn_rate, turn_variance = mean.item(rates + heading), covariance.item(rates + heading, rates + heading)
    heading_sigma_rad, turn_sigma_rad_s = sqrt(covariance.item(heading, heading)), sqrt(turn_variance)
    has_heading = heading_sigma_rad < _UNKNOWN_HEADING_RAD
    speeds = slice(rates, rates + 3)
    track = Track(
        robot,
        marker_id,
        x_m,
        y_m,
        z_m,
        (heading_rad + pi) % (2 * pi) - pi if has_heading else None,
        covariance[:3, :3] if pose.has_covariance else None,
        pose.cameras,
        pose.inside,
        mean[speeds],
        covariance[speeds, speeds] if pose.has_covariance else None,
        heading_sigma_rad if has_heading and pose.has_covariance else None,
        turn_rate if has_heading else None,
        turn_sigma_rad_s if has_heading and pose.has_covariance else None,
        pose.coasting_ns,
        pose.age_ns,
    )
    if states.turns is None:
        return track
    turning = slice(rates + 3, rates + 6)
    return replace(
        track,
        rotation_rad=rotation_vector(states.turns[row]),
        pose_covariance=covariance[:6, :6] if pose.has_covariance else None,
        angular_velocity_rad_s=mean[turning],
        angular_velocity_covariance_rad2_s2=covariance[turning, turning] if pose.has_covariance else None,
    )


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
        gap_ns = int(times_ns[row] - times_ns[row - 1])
        numbers[row] = numbers[row - 1] + begins_track(gap_ns, tracks[row].age_ns)
    return numbers


def begins_track(gap_ns: int, age_ns: int | None) -> bool:
    """Return whether a track begins at a row, by the time since the last row of its robot and its age."""
    return gap_ns > (_LONGEST_GAP_NS if age_ns is None else age_ns)
