"""The columns of tables of poses: attributed by their names and by their values, or refused."""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os.path import commonprefix
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.image_folders import parse_time
from ipsys_log.exchange.row_files import with_decimal_point
from ipsys_log.exchange.trajectory_tables import ANGLE_UNITS, LENGTH_UNITS, TIME_UNITS, BodyColumns, Layout
from ipsys_log.messages import Array
from ipsys_log.units import NS_PER_S

_ALIASES = {
    **{
        "s": "sec secs second seconds",
        "ms": "msec millisecond milliseconds",
        "us": "usec µs μs microseconds",
    },
    **{"ns": "nsec nsecs nanosec nanoseconds", "m": "meter meters metre metres", "cm": "centimeters"},
    **{"mm": "millimeter millimeters millimetres", "rad": "radian radians", "deg": "degree degrees °"},
}
UNITS = {name: unit for unit, names in _ALIASES.items() for name in (unit, *names.split())}
_BRACKETED = re.compile(r"(?P<stem>[^\[(]+?)[\s_./]*[\[(](?P<unit>[^\])]*)[\])]\s*")
_SUFFIXED = re.compile(r"(?P<stem>.+?)[\s_./-]+(?P<unit>[a-zµμ°]+)")
_PLACES = {"t", "p", "pos", "position", "trans", "translation", "point", "location", "loc"}
_TURNS = {"q", "quat", "quaternion", "orientation", "rotation", "rot", "attitude", "att", "ori"}
_AXIS = re.compile(r"(?P<kind>t|p|pos|q|quat|rot)?(?P<axis>[xyzw])")
_ANGLES = {"roll": "roll", "pitch": "pitch", "yaw": "yaw"} | dict.fromkeys(
    ("heading", "theta", "psi", "azimuth", "orientation"), "yaw"
)
# Words of messages, words that name no body if they are alone, and words of columns that are no poses.
_MESSAGE, _GENERIC, _OTHERS = (
    set(text.split())
    for text in (
        "field pose poses header stamp msg message data transform",
        "state estimate kalman rs r s g w b frame world map odom odometry global local gt groundtruth ground "
        "truth est estimated mocap vicon optitrack robot body rigid base link true ref",
        "v vel velocity linear angular twist a acc accel acceleration gyro omega bias imu mag force torque "
        "cov covariance std sigma sd err error residual target setpoint cmd command goal scale size",
    )
)
_TIMES = {"time", "timestamp", "t", "stamp", "times", "elapsed", "seconds", "sec", "secs"}
_LABELS = {"robot", "name", "body", "object", "subject", "marker"}
_UNIT_SPREAD = 2e-3


class Column(NamedTuple):
    """A column of a header: its place, its text, the words of its name, and its unit if it has one."""

    place: int
    text: str
    words: tuple[str, ...]
    unit: str | None


class _Axis(NamedTuple):
    """A column with an axis x, y, z or w of a position, of a rotation, or (kind empty) of one of them."""

    column: Column
    kind: str
    axis: str
    body: str


@dataclass(frozen=True, slots=True)
class GivenUnits:
    """The units of columns whose header has none: a key of ``TIME_UNITS`` and of ``LENGTH_UNITS``."""

    time: str | None = None
    length: str | None = None


def parse_header(cells: Sequence[str]) -> list[Column]:
    """Return the columns of a header.

    Examples
    --------
    >>> [(*column.words, column.unit) for column in parse_header(["p_RS_R_x [m]", "timeMs", "T (Seconds)"])]
    [('p', 'rs', 'r', 'x', 'm'), ('time', 'ms'), ('t', 's')]
    """
    columns = []
    for place, text in enumerate(cells):
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", text.strip().strip("#%")).lower().strip(" _/.")
        unit = None
        if match := _BRACKETED.fullmatch(name):
            name, unit = match["stem"], UNITS.get(match["unit"].strip(), match["unit"].strip())
        elif (match := _SUFFIXED.fullmatch(name)) and match["unit"] in UNITS:
            name, unit = match["stem"], UNITS[match["unit"]]
        columns.append(Column(place, text.strip(), tuple(re.findall(r"[^\W_]+", name)), unit or None))
    return columns


def attribute_columns(
    path: object, header: Sequence[str], sample: Sequence[Sequence[str]], given: GivenUnits
) -> tuple[Layout, list[str]]:
    """Return the layout of a table with a header, and what its columns were taken for, as texts.

    Raises
    ------
    IpsysError
        The columns of a position or of the time cannot be attributed, or a unit is not known.
    """
    columns = parse_header(header)
    values = sample_numbers(sample, len(columns))
    # A column with another value in each row counts the rows, and names no bodies.
    most = max(16, len(sample) // 4)
    named = (column.place for column in columns if _is_label(column))
    label = next((place for place in named if len({cells[place] for cells in sample}) <= most), None)
    bodies, remarks = _find_bodies(path, columns, values, given)
    time, tick_ns, said = _find_time(path, columns, sample, values, label, given)
    return Layout(bodies, time, tick_ns, label=label), [said, *remarks]


def _is_label(column: Column) -> bool:
    words = [word for word in column.words if word not in ("id", "rigid")] or ["id"]
    return len(words) < 3 and all(word in _LABELS for word in words)


def sample_numbers(sample: Sequence[Sequence[str]], width: int) -> Array:
    """Return the cells (rows, columns) of a sample as numbers; NaN for other cells."""
    values = np.full((len(sample), width), np.nan)
    for row, cells in zip(values, sample, strict=True):
        for place, text in enumerate(cells[:width]):
            try:
                row[place] = float(with_decimal_point(text))
            except ValueError:
                continue
    values[np.isinf(values)] = np.nan
    return values


def _find_bodies(
    path: object, columns: Sequence[Column], values: Array, given: GivenUnits
) -> tuple[tuple[BodyColumns, ...], list[str]]:
    axes = [axis for column in columns if (axis := _axis_of(column)) is not None]
    names = dict.fromkeys(axis.body for axis in axes)
    points = {name: _find_point(path, [axis for axis in axes if axis.body == name], values) for name in names}
    points = {name: point for name, point in points.items() if {"x", "y"} <= point.keys()}
    if not points:
        raise refuse_columns(path, columns, values, "no columns of a position are named")
    angles = _find_angles(columns)
    bodies, said = [], []
    for name, point in points.items():
        in_order = [point[axis] for axis in "xyz" if axis in point]
        about = _find_turn([axis for axis in axes if axis.body == name or len(points) == 1], in_order)
        form, per_rad, unit = "quaternion", [1.0], ""
        if not about:
            _check_no_quaternion(path, columns, values, in_order)
            by_angle = angles.get(name) or (next(iter(angles.values())) if len(angles) == 1 else {})
            form = "xyz" if len(by_angle) == 3 else "heading"
            about = [by_angle[key] for key in ("roll", "pitch", "yaw") if key in by_angle]
            about = about if form == "xyz" else about[-1:]
            per_rad = [_per_rad(path, column, values[:, column.place]) for column in about]
            unit = " in rad" if per_rad[-1:] == [1.0] else " in deg"
        is_named = form == "quaternion" and not {column.words for column in about} <= {*zip("xyzw")}
        per_m = [_per_m(path, column, given, is_named) for column in in_order]
        length = next(key for key, value in LENGTH_UNITS.items() if value == per_m[0])
        said.append(f"{_texts(in_order)}: position in {length}{'' if per_m[2:] else ' on the floor, z is 0'}")
        said += [f"{_texts(about)}: {'roll, pitch, yaw' if form == 'xyz' else form}{unit}"] * bool(about)
        places, turns = (tuple(column.place for column in some) for some in (in_order, about))
        bodies.append(BodyColumns(name, places, tuple(per_m), turns, form, tuple(per_rad)))
    return tuple(bodies), said[:2] + [f"so for {len(bodies)} bodies"] * (len(bodies) > 1)


def _texts(columns: Iterable[Column]) -> str:
    """Return the names of columns, with a long common beginning once: ``pose.position.(x y z)``."""
    names = [column.text for column in columns]
    start = commonprefix(names)  # noqa: RUF071 - of texts, not of paths
    if len(start) <= 3 or len(names) < 2:
        return " ".join(names)
    return f"{start}({' '.join(name.removeprefix(start) for name in names)})"


def _axis_of(column: Column) -> _Axis | None:
    words = column.words
    # Programs number the columns of the same name: x, y, z, x.1, y.1, z.1.
    words = words[:-1] if len(words) > 1 and words[-1].isdigit() and _AXIS.fullmatch(words[-2]) else words
    if len(words) > 1 and words[0] in {*"xyzw"} and words[1] in _PLACES | _TURNS:
        words = (*words[1:], words[0])  # "x position"
    match = _AXIS.fullmatch(words[-1]) if words else None
    if match is None or _OTHERS & {*words}:
        return None
    named = [word for word in (*words[:-1], match["kind"]) if word in _PLACES | _TURNS]
    kind = "" if not named else "turn" if named[-1] in _TURNS else "point"
    if kind != "turn" and column.unit not in (None, *LENGTH_UNITS):
        return None
    return _Axis(column, kind, match["axis"], _body_of(words[:-1]))


def _body_of(words: Iterable[str]) -> str:
    """Return the name of a body in the words before an axis or an angle; empty if they name none."""
    words = [word for word in words if word not in _MESSAGE | _PLACES | _TURNS]
    return "" if {*words} <= _GENERIC else "_".join(words)


def _find_point(path: object, axes: Sequence[_Axis], values: Array) -> dict[str, Column]:
    """Return the columns of a position by axis; those of a rotation may have equal names."""
    named = [axis for axis in axes if axis.kind == "point"] or [axis for axis in axes if not axis.kind]
    tuples = _split_tuples(named)
    if len(tuples) < 2:
        return {axis: column for axis, column in (tuples or [{}])[0].items() if axis != "w"}
    fours = [columns for columns in tuples if len(columns) == 4 and _is_unit(values, columns.values())]
    threes = [columns for columns in tuples if columns.keys() == {*"xyz"}]
    if len(tuples) == 2 and len(fours) == len(threes) == 1:
        return threes[0]
    raise refuse_columns(path, [axis.column for axis in named], values, "several columns have the same name")


def _find_turn(axes: Sequence[_Axis], point: Sequence[Column]) -> list[Column]:
    """Return the columns x y z w of a quaternion; empty if there is none."""
    turns = [axis for axis in axes if axis.kind == "turn"] or [axis for axis in axes if not axis.kind]
    tuples = _split_tuples([axis for axis in turns if axis.column not in point])
    return next(([columns[axis] for axis in "xyzw"] for columns in tuples if len(columns) == 4), [])


def _split_tuples(axes: Sequence[_Axis]) -> list[dict[str, Column]]:
    """Return the columns by axis, in a new tuple from each axis on that the tuple has already."""
    tuples: list[dict[str, Column]] = []
    for axis in axes:
        if not tuples or axis.axis in tuples[-1]:
            tuples.append({})
        tuples[-1][axis.axis] = axis.column
    return tuples


def _find_angles(columns: Iterable[Column]) -> dict[str, dict[str, Column]]:
    """Return the columns of roll, pitch and yaw, or of yaw alone, by body."""
    angles: dict[str, dict[str, Column]] = defaultdict(dict)
    for column in columns:
        if column.words and column.words[-1] in _ANGLES and not _OTHERS & {*column.words}:
            body = _body_of(word for word in column.words[:-1] if word != "stabilizer")
            angles[body].setdefault(_ANGLES[column.words[-1]], column)
    return {body: found for body, found in angles.items() if "yaw" in found}


def _is_unit(values: Array, columns: Iterable[Column]) -> bool:
    return is_unit_length(values[:, [column.place for column in columns]])


def is_unit_length(rows: Array) -> bool:
    """Return whether nearly all rows have the length 1; rows of zeros do not count."""
    lengths = np.linalg.norm(rows, axis=1)
    lengths = lengths[np.isfinite(lengths) & (lengths > 0)]
    return len(lengths) > 0 and bool(np.mean(np.abs(lengths - 1) < _UNIT_SPREAD) > 0.98)


def _check_no_quaternion(
    path: object, columns: Sequence[Column], values: Array, point: Sequence[Column]
) -> None:
    """Refuse a position that has the length 1 together with another column: it is part of a quaternion."""
    for column in columns if len(point) == 3 and len(values) > 1 else ():
        if column not in point and np.any(values[:, column.place]) and _is_unit(values, [*point, column]):
            reason = f"{_texts(sorted([*point, column]))} is a quaternion (length 1), not a position"
            raise refuse_columns(path, columns, values, reason)


def refuse_columns(path: object, columns: Sequence[Column], values: Array, reason: str) -> IpsysError:
    """Return the error for columns that cannot be attributed, with all columns of numbers as candidates."""
    texts = [
        f"{column.text or 'without a name'} (column {column.place + 1}, "
        f"{np.nanmin(values[:, column.place]):g} to {np.nanmax(values[:, column.place]):g})"
        for column in columns
        if np.isfinite(values[:, column.place]).any()
    ]
    return IpsysError(
        f"{path}: {reason}; name the columns like time_s, robot, x_m, y_m, z_m, qx, qy, qz, qw. "
        f"Candidates: {', '.join(texts[:12]) or 'none'}{', ...' if len(texts) > 12 else ''}"
    )


def _per_m(path: object, column: Column, given: GivenUnits, is_named: bool) -> float:
    """Return the unit of a position; the names of TUM, of messages of ROS and of cflib mean metres."""
    is_si = is_named or {*column.words} >= {"pose", "position"} or {"estimate", "kalman"} & {*column.words}
    unit = column.unit or given.length or ("m" if is_si else None)
    if unit is None:
        raise _unknown_unit(path, column, "m or", "mm, or add --length-unit m")
    return LENGTH_UNITS[unit]


def _per_rad(path: object, column: Column, values: Array) -> float:
    is_cflib = bool({"stabilizer", "estimate"} & {*column.words})
    unit = column.unit
    if unit is None:
        most = np.nanmax(np.abs(values), initial=0.0)
        unit = "deg" if is_cflib or most >= 60 else "rad" if most <= 2 * np.pi else None
    if unit not in ANGLE_UNITS:
        raise _unknown_unit(path, column, "rad or", "deg")
    # The pitch of a Crazyflie is positive with the nose up.
    return ANGLE_UNITS[unit] * (-1 if is_cflib and column.words[-1] == "pitch" else 1)


def _unknown_unit(path: object, column: Column, *advice: str) -> IpsysError:
    names = " ".join(f"{column.text}_{text}" for text in advice)
    return IpsysError(f"{path}: the unit of column {column.text} is not known; write {names}")


def _find_time(
    path: object,
    columns: Sequence[Column],
    sample: Sequence[Sequence[str]],
    values: Array,
    label: int | None,
    given: GivenUnits,
) -> tuple[tuple[int, ...], int | None, str]:
    """Return the columns of the time, their unit in ns (None: ISO 8601), and a text."""
    ranked: list[tuple[int, tuple[int, ...]]] = []
    rests = {_stem(column): column.place for column in columns if _has_nanoseconds(column, values)}
    for column in columns:
        last = column.words[-1] if column.words else ""
        is_whole = not np.any(np.nan_to_num(values[:, column.place]) % 1)
        if is_whole and "s" in (column.unit, UNITS.get(last)) and (stem := _stem(column)) in rests:
            ranked.append((0, (column.place, rests[stem])))
        elif last == "stamp":
            ranked.append((1, (column.place,)))
        elif "".join(column.words) in _TIMES:
            ranked.append((2, (column.place,)))
        elif last in ("time", "timestamp"):
            ranked.append((3, (column.place,)))
    if not ranked:
        raise refuse_columns(path, columns, values, "the header has no column time")
    # A header without a stamp has zeros.
    time = next((places for _, places in sorted(ranked) if np.any(values[:, places[0]])), ranked[0][1])
    column = columns[time[0]]
    if len(time) == 2:
        return time, NS_PER_S, f"{column.text}: time in s, and ns"
    unit = column.unit or given.time
    texts = [cells[column.place].strip() for cells in sample]
    if unit is None and texts:
        rows = [label is None or cells[label] == sample[0][label] for cells in sample]
        is_tum = any(other.words == ("tx",) for other in columns)
        by_rate = "s" if is_tum else time_unit_of(texts, values[rows, column.place])
        unit = epoch_unit_of(texts) or "s" if is_tum else by_rate
    if unit is not None and unit not in TIME_UNITS:
        known = ", ".join(TIME_UNITS)
        raise IpsysError(f"{path}: the time column has the unit {unit!r}; use one of {known}")
    if unit is None and np.isfinite(values[:, column.place]).any():
        raise _unknown_unit(path, column, "s or", "ms, or add --time-unit s")
    return time, None if unit is None else TIME_UNITS[unit], f"{column.text}: time in {unit or 'ISO 8601'}"


def _stem(column: Column) -> tuple[str, ...]:
    return tuple(word for word in column.words if UNITS.get(word) not in ("s", "ns"))


def _has_nanoseconds(column: Column, values: Array) -> bool:
    """Return whether a column has the nanoseconds after a whole second."""
    is_named = "ns" in (column.unit, *(UNITS.get(word) for word in column.words[-1:]))
    return is_named and bool(np.all(np.nan_to_num(values[:, column.place]) < NS_PER_S))


def time_unit_of(texts: Iterable[str], values: Array) -> str | None:
    """Return the unit of times by their digits since 1970, or by their rate; None if both are unclear.

    No system writes more than 1000 poses per second, and few write less than one.
    """
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    step = float(np.median(steps)) if len(steps) else 0.0
    by_rate = (
        unit for unit, tick_ns in TIME_UNITS.items() if (1e6 if unit == "s" else 4e6) <= step * tick_ns < 1e9
    )
    since_1970 = epoch_unit_of(texts)
    is_slow = since_1970 is not None and step * TIME_UNITS[since_1970] > 100 * NS_PER_S
    return next(by_rate, None) if since_1970 is None or is_slow else since_1970


def epoch_unit_of(texts: Iterable[str]) -> str | None:
    """Return the unit of times since 1970 by their digits; None for other times."""
    text = with_decimal_point(next((text for text in texts if text), ""))
    try:
        tick_ns = parse_time(text) / float(text)
    except ValueError:
        return None
    return next((unit for unit, own in TIME_UNITS.items() if np.isclose(tick_ns, own)), None)
