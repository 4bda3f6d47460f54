"""Disagreement of cameras in their overlap, in a log or a stream: a figure for accuracy without a tape.

For a robot that two cameras see, it is the difference of their positions at one instant. Cameras are seldom
in step. So the position of one camera is interpolated on a straight line between its sightings before and
after the instant, at most 0.3 s apart. At 0.26 m/s on a bend with a radius of 0.3 m, a line of 0.1 s is wrong
by 0.3 mm at most, and a line of 0.3 s by 2.5 mm (v^2 t^2 / 8 r). The disagreement does not contain an error
that both cameras share.
"""

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import LogError
from ipsys_log.log.codec import schema_name
from ipsys_log.log.columns import read_columns
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, Message, Position, Positions, Rig, Times
from ipsys_log.messages.channels import POSITIONS, RIG
from ipsys_log.units import MM_PER_M, NS_PER_S
from ipsys_log.vision.time_brackets import bracket_times

# Longest time between two sightings of a camera, for a position in between.
LONGEST_GAP_NS = 300_000_000
# Squared Mahalanobis distance in two dimensions that holds 95 %.
_SQUARE_95 = -2 * np.log(1 - 0.95)
_FIELDS = ("id", "x_m", "y_m", "covariance_m2", "inside", "time_offset_ns")
_FEWEST = 3
_MOST_INTERVALS = 60
_FARTHEST_M = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class CameraPositions:
    """The positions of a camera on the floor, in any order.

    Attributes
    ----------
    camera : its name.
    ids, times_ns : (n,), marker ids, and the instants of the exposures.
    points_m : (n, 2).
    covariances_m2 : (n, 2, 2), NaN if unknown.
    """

    camera: str
    ids: Times
    times_ns: Times
    points_m: Array
    covariances_m2: Array


@dataclass(frozen=True, slots=True, eq=False)
class PairDisagreement:
    """The differences of the positions of two cameras, in order of time.

    Attributes
    ----------
    cameras : their names; a difference is the first camera minus the second.
    times_ns, ids : (n,).
    points_m, differences_m : (n, 2), the mean position and the difference.
    squares : (n,), squared Mahalanobis distances by the sum of both covariances; NaN if unknown. This sum
        neglects the errors that both cameras share.
    """

    cameras: tuple[str, str]
    times_ns: Times
    ids: Times
    points_m: Array
    differences_m: Array
    squares: Array

    @property
    def lengths_m(self) -> Array:
        """The lengths (n,) of the differences."""
        return np.asarray(np.linalg.norm(self.differences_m, axis=1))

    @property
    def median_m(self) -> float:
        """The median length."""
        return float(np.median(self.lengths_m))

    @property
    def p95_m(self) -> float:
        """The length that 95 % of the differences do not exceed."""
        return float(np.percentile(self.lengths_m, 95))

    @property
    def within_95(self) -> float | None:
        """The share of the differences in the 95 % region of their covariance; None without covariances."""
        known = self.squares[np.isfinite(self.squares)]
        return float((known <= _SQUARE_95).mean()) if len(known) else None


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of the floor: its centre, the number of differences, and their median length, in m."""

    x_m: float
    y_m: float
    count: int
    median_m: float


@dataclass(frozen=True, slots=True)
class DisagreementInterval:
    """A time interval: its middle, the number of differences, and their lengths, in m."""

    time_ns: int
    count: int
    median_m: float
    p95_m: float


def read_disagreement(session: Session, run: str, without: Collection[int] = ()) -> list[PairDisagreement]:
    """Return the disagreement of all pairs of cameras with common robots in a run, sorted by name.

    Positions that a model marks as not inside are left out. The values are read as columns: a log of an hour
    takes seconds.

    Parameters
    ----------
    session : open logs.
    run : the run with the positions.
    without : marker ids to leave out, such as those of reference markers.
    """
    parts, cameras = session.part_counter(), []
    for topic in session.topics(POSITIONS, run):
        rows = [(publish_ns, data) for _, _, publish_ns, data in session.encoded([topic])]
        columns = read_columns(schema_name(Positions), [data for _, data in rows], _FIELDS, parts)
        fields = columns.fields
        kept = ~((fields["inside"].values == 0) & ~fields["inside"].missing)
        kept &= ~np.isin(fields["id"].values, list(without))
        points_m = np.column_stack([fields["x_m"].values, fields["y_m"].values])
        kept &= (np.abs(points_m) < _FARTHEST_M).all(axis=1)  # False for NaN
        times_ns = np.array([publish_ns for publish_ns, _ in rows], dtype=np.int64)[columns.message]
        covariances = np.full((len(kept), 9), np.nan)
        known = ~fields["covariance_m2"].missing
        if known.any() and fields["covariance_m2"].values.shape[1] != 9:
            raise LogError(f"{session}: {topic} has covariances that are not 3 x 3")
        if known.any():
            covariances[known] = fields["covariance_m2"].values[known]
        cameras.append(
            CameraPositions(
                str(camera_of_topic(topic)),
                fields["id"].values[kept],
                (times_ns + fields["time_offset_ns"].values)[kept],
                points_m[kept],
                covariances.reshape(-1, 3, 3)[kept, :2, :2],
            )
        )
    return compare_cameras(cameras)


def reference_ids(session: Session) -> set[int]:
    """Return the ids of the reference markers in the rigs of a log: they are no robots."""
    return {marker.id for rig in session.payloads(session.topics(RIG)) for marker in rig.reference_markers}


def compare_cameras(cameras: Sequence[CameraPositions]) -> list[PairDisagreement]:
    """Return the disagreement of all pairs of cameras that have common robots."""
    ordered = sorted(cameras, key=lambda positions: positions.camera)
    pairs = [_compare(first, second) for first, second in combinations(ordered, 2)]
    return [pair for pair in pairs if len(pair.times_ns)]


def _compare(first: CameraPositions, second: CameraPositions) -> PairDisagreement:
    """Compare the sightings of the first camera with the line between two sightings of the second."""
    parts = []
    for marker_id in np.intersect1d(first.ids, second.ids).tolist():
        own, other = _in_order(first, marker_id), _in_order(second, marker_id)
        brackets = bracket_times(other.times_ns, own.times_ns, LONGEST_GAP_NS)
        # No line leads to the first sighting after a gap.
        has_line = np.append(False, np.diff(other.times_ns) <= LONGEST_GAP_NS)
        rows = np.flatnonzero(brackets.is_known & has_line[brackets.after])
        line_m = brackets.mix(other.points_m)[rows]
        spread_m2 = brackets.mix(other.covariances_m2)[rows]
        differences_m = own.points_m[rows] - line_m
        squares = _squares(differences_m, own.covariances_m2[rows] + spread_m2)
        ids = np.full(len(rows), marker_id, dtype=np.int64)
        parts.append((own.times_ns[rows], ids, (own.points_m[rows] + line_m) / 2, differences_m, squares))
    names = first.camera, second.camera
    if not parts:
        empty = np.empty(0, dtype=np.int64)
        return PairDisagreement(names, empty, empty, np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    times_ns, ids, points_m, differences_m, squares = (column[order] for column in joined)
    return PairDisagreement(names, times_ns, ids, points_m, differences_m, squares)


def _in_order(positions: CameraPositions, marker_id: int) -> CameraPositions:
    rows = np.flatnonzero(positions.ids == marker_id)
    rows = rows[np.argsort(positions.times_ns[rows], kind="stable")]
    return CameraPositions(
        positions.camera,
        positions.ids[rows],
        positions.times_ns[rows],
        positions.points_m[rows],
        positions.covariances_m2[rows],
    )


def _squares(differences_m: Array, covariances_m2: Array) -> Array:
    known: NDArray[np.bool_] = np.asarray(np.isfinite(covariances_m2).all(axis=(1, 2)))
    known &= np.linalg.det(np.where(known[:, None, None], covariances_m2, np.eye(2))) > 0
    squares = np.full(len(differences_m), np.nan)
    scaled = np.linalg.solve(covariances_m2[known], differences_m[known][..., None])[..., 0]
    squares[known] = (differences_m[known] * scaled).sum(axis=1)
    return squares


def divide_floor(pairs: Sequence[PairDisagreement], size_m: float = 0.25) -> list[Cell]:
    """Return the cells of the floor with at least three differences, of all pairs together."""
    if not pairs:
        return []
    points_m = np.concatenate([pair.points_m for pair in pairs])
    lengths_m = np.concatenate([pair.lengths_m for pair in pairs])
    keys, index = np.unique(np.floor(points_m / size_m).astype(np.int64), axis=0, return_inverse=True)
    index = index.reshape(-1)
    cells = []
    for number, (column, row) in enumerate(keys.tolist()):
        own = lengths_m[index == number]
        if len(own) >= _FEWEST:
            centre = (column + 0.5) * size_m, (row + 0.5) * size_m
            cells.append(Cell(*centre, len(own), float(np.median(own))))
    return cells


def divide_time(pair: PairDisagreement) -> list[DisagreementInterval]:
    """Return at most 60 intervals with at least three differences, each of at least a second."""
    first_ns, last_ns = int(pair.times_ns[0]), int(pair.times_ns[-1]) + 1
    step_ns = max(NS_PER_S, -(-(last_ns - first_ns) // _MOST_INTERVALS))
    numbers = (pair.times_ns - first_ns) // step_ns
    intervals = []
    for number in np.unique(numbers).tolist():
        own = pair.lengths_m[numbers == number]
        if len(own) >= _FEWEST:
            middle_ns = first_ns + number * step_ns + step_ns // 2
            median_m, p95_m = np.percentile(own, [50, 95]).tolist()
            intervals.append(DisagreementInterval(middle_ns, len(own), median_m, p95_m))
    return intervals


# Number of the last differences of a pair that a summary uses.
_REMEMBERED = 5_000
_FEWEST_DIFFERENCES = 10
# A display has room for so many pairs. A hall of 24 cameras has dozens.
_MOST_LINES = 6


class Difference(NamedTuple):
    """The difference in x and y, in m, of the positions of two cameras at an instant; first minus second.

    ``place_x_m`` and ``place_y_m`` are the position of the marker.
    """

    cameras: tuple[str, str]
    marker_id: int
    time_ns: int
    x_m: float
    y_m: float
    place_x_m: float
    place_y_m: float


class OverlapStream:
    """The differences of cameras in a stream; it reads the first run with positions.

    A new sighting of one camera ends a line that passes the last sightings of the other cameras. There, the
    difference is known.

    Parameters
    ----------
    rig : names the reference markers, which are left out.
    """

    def __init__(self, rig: Rig | None = None) -> None:
        self._rig, self._run = rig, ""
        # By marker, the last sighting of each camera: a hall has many cameras, and few see the same marker.
        self._last: dict[int, dict[str, tuple[int, Position]]] = {}

    def __call__(self, message: Message) -> Iterator[Difference]:
        """Yield the differences that a message completes."""
        if not isinstance(message.payload, Positions):
            return
        self._run = self._run or str(run_of_topic(message.topic))
        if run_of_topic(message.topic) != self._run:
            return
        camera = str(message.camera)
        for position in message.payload.positions:
            is_reference = self._rig is not None and self._rig.is_reference(position.id)
            if position.inside is not False and not is_reference:
                time_ns = message.payload.timestamp + (position.time_offset_ns or 0)
                sightings = self._last.setdefault(position.id, {})
                yield from self._compare(sightings, camera, time_ns, position)
                sightings[camera] = time_ns, position

    def _compare(
        self, sightings: dict[str, tuple[int, Position]], camera: str, time_ns: int, position: Position
    ) -> Iterator[Difference]:
        before = sightings.get(camera)
        if before is None or not 0 < time_ns - before[0] <= LONGEST_GAP_NS:
            return
        for other, (other_ns, seen) in sightings.items():
            if other == camera or not before[0] <= other_ns < time_ns:
                continue
            share = (other_ns - before[0]) / (time_ns - before[0])
            x_m = (1 - share) * before[1].x_m + share * position.x_m - seen.x_m
            y_m = (1 - share) * before[1].y_m + share * position.y_m - seen.y_m
            sign = 1.0 if camera < other else -1.0
            pair = min(camera, other), max(camera, other)
            yield Difference(pair, position.id, other_ns, sign * x_m, sign * y_m, seen.x_m, seen.y_m)


class OverlapSummary:
    """The disagreement of each pair of cameras over the last minutes, for a display."""

    def __init__(self) -> None:
        self._stream = OverlapStream()
        self._lengths_m: dict[tuple[str, str], deque[float]] = {}

    def __call__(self, message: Message) -> None:
        """Handle one message; the rig names the reference markers."""
        if isinstance(message.payload, Rig):
            self._stream = OverlapStream(message.payload)
        for difference in self._stream(message):
            lengths_m = self._lengths_m.setdefault(difference.cameras, deque(maxlen=_REMEMBERED))
            lengths_m.append(float(np.hypot(difference.x_m, difference.y_m)))

    def lines(self) -> list[str]:
        """Return one line for each pair of cameras; of many pairs, only those that differ most."""
        pairs = {
            pair: (np.percentile(lengths_m, [50, 95]) * MM_PER_M).tolist()
            for pair, lengths_m in sorted(self._lengths_m.items())
            if len(lengths_m) >= _FEWEST_DIFFERENCES
        }
        shown = sorted(sorted(pairs, key=lambda pair: -pairs[pair][0])[:_MOST_LINES])
        lines = []
        for first, second in shown:
            median_mm, p95_mm = pairs[first, second]
            figures = f"{median_mm:.1f} mm (median), {p95_mm:.1f} mm (p95)"
            lines.append(f"positions of cameras {first} and {second} differ by {figures}")
        if len(pairs) > len(shown):
            lines.append(f"the other {len(pairs) - len(shown)} pairs of cameras differ less")
        return lines
