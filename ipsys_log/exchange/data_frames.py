"""Channels as pandas tables: one row for each marker, point, position or track."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError, LogError
from ipsys_log.exchange.table_columns import expand_field
from ipsys_log.extras import check_installed
from ipsys_log.log.codec import schema_name
from ipsys_log.log.columns import Columns, read_columns
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CameraPoints,
    Event,
    Latency,
    Markers,
    Measurement,
    Message,
    Pair,
    Positions,
    Tracks,
    WheelCommand,
)
from ipsys_log.messages.channels import (
    CAMERA_POINTS,
    COMMANDS,
    ESTIMATE,
    EVENTS,
    LATENCY,
    MARKERS,
    MEASUREMENTS,
    POSITIONS,
    RIG,
    SMOOTHED_TRACKS,
    TRACKS,
    TRUTH,
    Channel,
)
from ipsys_log.models.tracking.track_messages import begins_track
from ipsys_log.statistics.calibration_points import build_pairs, gather_sightings, valid_measurements

if TYPE_CHECKING:
    import pandas as pd

_BATCH = 1 << 16  # number of messages that are read at once: a larger batch takes memory, and is no faster

_POINT = ("id", "x_m", "y_m", "z_m", "heading_rad", "covariance_m2")
_MOTION = (
    "velocity_m_s",
    "velocity_covariance_m2_s2",
    "turn_rate_rad_s",
    "heading_sigma_rad",
    "turn_rate_sigma_rad_s",
    "coasting_ns",
    "age_ns",
)
_TRACK = ("robot", *_POINT, "cameras", "inside", *_MOTION)
# Fields of tracks of bodies that are not level.
_TURN = ("rotation_rad", "pose_covariance", "angular_velocity_rad_s")


class _Table(NamedTuple):
    """A table: its channel, the payload with the items, and the fields of an item in the order of columns."""

    channel: Channel
    payload: type
    fields: tuple[str, ...]


_ITEMS = {
    "markers": _Table(MARKERS, Markers, ("id", "corners_px", "time_offset_ns", "edge_offset_px")),
    "camera_points": _Table(CAMERA_POINTS, CameraPoints, (*_POINT, "time_offset_ns")),
    "positions": _Table(POSITIONS, Positions, (*_POINT, "inside", "time_offset_ns")),
    "tracks": _Table(TRACKS, Tracks, _TRACK),
    "smoothed_tracks": _Table(SMOOTHED_TRACKS, Tracks, _TRACK),
    "truth": _Table(TRUTH, Tracks, ("robot", *_POINT)),
    "estimate": _Table(ESTIMATE, Tracks, ("robot", *_POINT, "heading_sigma_rad")),
}
TABLES = (*_ITEMS, "measurements", "events", "latency", "commands", "pairs")


def import_pandas() -> Any:
    """Return the module pandas."""
    check_installed("tables need", "pandas")
    import pandas as pd

    return pd


def read_table(
    session: Session, name: str, runs: Sequence[str | None], start_ns: int | None, end_ns: int | None
) -> pd.DataFrame:
    """Read a channel as a table.

    Parameters
    ----------
    name : one of :data:`TABLES`.
    runs : the runs to read; with several runs, a column names the run. None for a recorded channel.
    start_ns, end_ns : log times; the end is not included.
    """
    pandas = _import_for(name)
    tables = [_read_run(pandas, session, name, run, start_ns, end_ns) for run in runs]
    if len(runs) == 1:
        return tables[0]
    named = [table.assign(run=run) for run, table in zip(runs, tables, strict=True)]
    joined: pd.DataFrame = pandas.concat(named, ignore_index=True)
    return joined


def read_table_parts(
    session: Session, name: str, run: str | None, with_turns: bool = False
) -> Iterator[pd.DataFrame]:
    """Yield a channel as tables of limited size, in log order: at least one, which may be empty.

    Parameters
    ----------
    name : one of :data:`TABLES`.
    run : the run to read; None for a recorded channel.
    with_turns : tracks have the columns of bodies that are not level, also if the rig has none.
    """
    pandas = _import_for(name)
    if name in _ITEMS:
        for part in _item_parts(session, _ITEMS[name], run, None, None, with_turns):
            yield _typed(pandas, pandas.DataFrame(part, copy=False))
    else:
        yield _read_run(pandas, session, name, run, None, None)


def _import_for(name: str) -> Any:
    pandas = import_pandas()
    if name not in TABLES:
        raise IpsysError(f"table {name!r} is not known; use one of {', '.join(TABLES)}")
    return pandas


def _read_run(
    pd: Any, session: Session, name: str, run: str | None, start_ns: int | None, end_ns: int | None
) -> pd.DataFrame:
    if name in _ITEMS:
        parts = list(_item_parts(session, _ITEMS[name], run, start_ns, end_ns))
        joined = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
        return _typed(pd, pd.DataFrame(joined, copy=False))
    if name == "pairs":
        rows = list(_pair_rows(session, run, start_ns, end_ns))
    else:
        channel, row = _ROWS[name]
        messages = session.messages(session.topics(channel), start_ns, end_ns)
        rows = [_times(message) | row(message) for message in messages]
    return _typed(pd, pd.DataFrame(rows, columns=_COLUMNS[name]))


def _item_parts(
    session: Session,
    table: _Table,
    run: str | None,
    start_ns: int | None,
    end_ns: int | None,
    with_turns: bool = False,
) -> Iterator[dict[str, Any]]:
    if table.payload is Tracks and (with_turns or _has_free_body(session)):
        table = table._replace(fields=(*table.fields, *_TURN))
    topics = session.topics(table.channel, run)
    items = session.part_counter()
    has_camera = "{camera}" in table.channel.topic
    by_topic = {topic: camera_of_topic(topic) for topic in topics}
    messages = session.encoded(topics, start_ns, end_ns)
    segments = _Segments()
    is_first = True
    while (batch := list(islice(messages, _BATCH))) or is_first:
        is_first = False
        times = np.array([(publish_ns, log_ns) for _, log_ns, publish_ns, _ in batch], np.int64)
        cameras = [by_topic[topic] for topic, *_ in batch] if has_camera else []
        encoded = [data for *_, data in batch]
        try:
            columns = read_columns(schema_name(table.payload), encoded, table.fields, items)
        except LogError as error:
            raise LogError(f"{session}: {table.channel.name}: {error}") from error
        part = _part(columns, times.reshape(-1, 2), cameras, table)
        yield segments.add(part) if "robot" in part else part


def _has_free_body(session: Session) -> bool:
    """Return whether a rig of the log, or of one of its runs, has a body that is not level."""
    rigs = [*session.payloads(session.topics(RIG)), *(record.rig for record in session.runs() if record.rig)]
    return any(not body.level for rig in rigs for body in rig.bodies)


class _Segments:
    """The numbers of the unbroken tracks of a table, over its parts."""

    def __init__(self) -> None:
        self._count = 0
        self._last: dict[tuple[str, int], tuple[int, int]] = {}  # time and number, by robot and marker

    def add(self, part: dict[str, Any]) -> dict[str, Any]:
        """Return a part of a table with the column ``segment``."""
        times_ns, numbers = part["time"].tolist(), []
        keys = zip(part["robot"], part["marker_id"].tolist(), strict=True)
        ages_ns = part.get("age_ns", [None] * len(times_ns))
        for key, time_ns, age_ns in zip(keys, times_ns, ages_ns, strict=True):
            last_ns, number = self._last.get(key, (0, -1))
            if number < 0 or begins_track(time_ns - last_ns, age_ns):
                number, self._count = self._count, self._count + 1
            self._last[key] = time_ns, number
            numbers.append(number)
        return {**part, "segment": np.array(numbers, np.int64)}


def _part(
    columns: Columns, times_ns: NDArray[np.int64], cameras: Sequence[str | None], table: _Table
) -> dict[str, Any]:
    rows: dict[str, Any] = {
        "time": times_ns[columns.message, 0],
        "log_time_ns": times_ns[columns.message, 1],
    }
    if "{camera}" in table.channel.topic:
        rows["camera"] = np.array(cameras, object)[columns.message]
    for name in table.fields:
        rows |= expand_field(name, columns.fields[name])
    return rows


_TIMES = ("time", "still_start", "still_end", "received", "detected", "located", "fused", "published")
_INTEGERS = ("time_offset_ns", "coasting_ns", "age_ns")


def _typed(pd: Any, table: pd.DataFrame) -> pd.DataFrame:
    """Set the types of the columns of a table: times are in UTC, missing values are NaN or NA."""
    for name in _TIMES:
        if name in table:
            times = pd.to_datetime(table[name], unit="ns", utc=True)
            table[name] = times.astype("datetime64[ns, UTC]")
    for name in ("camera", "robot"):
        if name in table:
            table[name] = table[name].astype("category")
    if "inside" in table:
        table["inside"] = table["inside"].astype("boolean")
    for name in _INTEGERS:
        if name in table:
            table[name] = table[name].astype("Int64")
    if "marker_id" in table and table["marker_id"].dtype == object:
        table["marker_id"] = table["marker_id"].astype("Int64")
    return table


def _times(message: Message) -> dict[str, Any]:
    return {"time": message.publish_time_ns, "log_time_ns": message.log_time_ns}


def _measurement(message: Message) -> dict[str, Any]:
    measurement: Measurement = message.payload
    point = measurement.point
    return {
        "id": measurement.id,
        "marker_id": measurement.marker_id,
        "side": measurement.side,
        "height_m": measurement.height_m,
        "x_m": None if point is None else point.x_m,
        "y_m": None if point is None else point.y_m,
        "z_m": None if point is None else point.z_m,
        "still_start": None if measurement.still is None else measurement.still.start,
        "still_end": None if measurement.still is None else measurement.still.end,
        "distances_m": {distance.reference: distance.distance_m for distance in measurement.distances},
        "splits": measurement.splits,
        "withdraws": measurement.withdraws,
        "readmits": measurement.readmits,
        "from_reference": measurement.from_reference,
        "reason": measurement.reason,
    }


def _event(message: Message) -> dict[str, Any]:
    event: Event = message.payload
    return {
        "kind": event.kind,
        "camera": event.camera,
        "marker_id": event.marker_id,
        "text": event.text,
    }


def _latency(message: Message) -> dict[str, Any]:
    latency: Latency = message.payload
    names = ("camera", "received", "detected", "located", "fused", "published")
    return {name: getattr(latency, name) for name in names}


def _command(message: Message) -> dict[str, Any]:
    command: WheelCommand = message.payload
    names = ("robot", "left_m_s", "right_m_s", "state", "waypoint", "x_m", "y_m", "position_time")
    return {name: getattr(command, name) for name in names}


def _pair_rows(
    session: Session, run: str | None, start_ns: int | None, end_ns: int | None
) -> Iterator[dict[str, Any]]:
    """Yield the calibration points of each camera; the range applies to the log times of measurements."""
    sightings = gather_sightings(session.messages(session.topics(CAMERA_POINTS, run)))
    messages = [*session.messages([*session.topics(RIG), *session.topics(MEASUREMENTS)])]
    entered = {
        message.payload.id: message for message in messages if isinstance(message.payload, Measurement)
    }
    for camera, pairs in build_pairs(sightings, valid_measurements(messages, None)).items():
        for pair in pairs:
            message = entered[pair.measurement]
            if (start_ns or 0) <= message.log_time_ns and (end_ns is None or message.log_time_ns < end_ns):
                yield _times(message) | {"camera": camera} | _pair(pair, message.payload)


def _pair(pair: Pair, measurement: Measurement) -> dict[str, Any]:
    return {
        "id": pair.measurement,
        "marker_id": pair.marker_id,
        **dict(zip(("xc_m", "yc_m", "zc_m"), pair.camera_m.tolist(), strict=True)),
        **dict(zip(("xw_m", "yw_m", "zw_m"), pair.world_m.tolist(), strict=True)),
        "frames": pair.frames,
        "splits": measurement.splits,
        "calibration_point": pair.calibration_point,
    }


_ROWS: Mapping[str, tuple[Channel, Callable[[Message], dict[str, Any]]]] = {
    "measurements": (MEASUREMENTS, _measurement),
    "events": (EVENTS, _event),
    "latency": (LATENCY, _latency),
    "commands": (COMMANDS, _command),
}
_COLUMNS = {
    "measurements": [
        *("time", "log_time_ns", "id", "marker_id", "side", "height_m", "x_m", "y_m", "z_m"),
        *("still_start", "still_end", "distances_m", "splits", "withdraws"),
        *("readmits", "from_reference", "reason"),
    ],
    "pairs": [
        *("time", "log_time_ns", "camera", "id", "marker_id", "xc_m", "yc_m", "zc_m"),
        *("xw_m", "yw_m", "zw_m", "frames", "splits", "calibration_point"),
    ],
    "events": ["time", "log_time_ns", "kind", "camera", "marker_id", "text"],
    "latency": ["time", "log_time_ns", "camera", "received", "detected", "located", "fused", "published"],
    "commands": [
        *("time", "log_time_ns", "robot", "left_m_s", "right_m_s", "state", "waypoint"),
        *("x_m", "y_m", "position_time"),
    ],
}
