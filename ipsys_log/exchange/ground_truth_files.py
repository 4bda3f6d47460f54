"""Reader of ground truth from motion capture systems: CSV tables and TUM trajectories."""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.image_folders import parse_time
from ipsys_log.exchange.row_files import open_as_text, parse_number, read_cells
from ipsys_log.messages import Array
from ipsys_log.units import MM_PER_M, NS_PER_S

TIME_UNITS = {"s": NS_PER_S, "ns": 1}
LENGTH_UNITS = {"m": 1.0, "mm": MM_PER_M}
# A column is a name and a unit: time_s, "x [mm]", "heading (rad)".
_COLUMN = re.compile(r"(?P<name>[a-z]+)[\s_]*[\[(]?(?P<unit>ns|s|mm|m|rad|deg)?[\])]?")
_TIME_NAMES, _AXES, _QUATERNION = ("time", "timestamp"), ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_TUM_FIELDS = 8
_LATEST_NS = 1 << 62
# A quaternion with another length is no rotation.
_UNIT_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class TruthPath:
    """The true path of a robot, in the coordinates and the clock of its file.

    Attributes
    ----------
    times_ns : (n,), ascending.
    points_m : (n, 3), positions of the marker.
    forward : (n, 3), unit vectors of the heading; NaN where it is unknown.
    """

    robot: str
    times_ns: NDArray[np.int64]
    points_m: Array
    forward: Array


@dataclass(frozen=True, slots=True)
class TruthUnits:
    """The units of columns whose header has none: a key of ``TIME_UNITS`` and of ``LENGTH_UNITS``."""

    time: str | None = None
    length: str | None = None


class _Row(NamedTuple):
    robot: str | None
    time_ns: int
    point_m: tuple[float, float, float]
    forward: tuple[float, float, float]
    line: int


_UNKNOWN = (float("nan"),) * 3


def read_truth_files(
    paths: Sequence[Path], robots: Sequence[str] = (), units: TruthUnits | None = None
) -> list[TruthPath]:
    """Read the ground truth of one or several robots.

    A TUM file (``.tum`` or ``.txt``) has the path of one robot: lines with the time in s, ``x y z`` in m and
    ``qx qy qz qw``. A CSV file has a header. Its columns are a time (``time_s``, ``time_ns``, or ``time`` in
    ISO 8601), ``x``, ``y``, ``z`` with a unit (``x_m``, ``x_mm``), and optionally ``robot``, ``heading_rad``
    or ``heading_deg``, and ``qx qy qz qw``. A row without a position is left out. The heading of a quaternion
    is the direction of its x axis.

    Parameters
    ----------
    robots : the robot of each file that names none, in the order of the files.
    units : the units of columns whose header has none.

    Raises
    ------
    IpsysError
        A file cannot be read, is empty, has text instead of a number, or its times do not increase.

    References
    ----------
    TUM: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
    """
    names, found = list(robots), dict[str, TruthPath]()
    for path in paths:
        rows = _read_rows(path, units or TruthUnits())
        if not rows:
            raise IpsysError(f"{path}: has no positions; export it again from the other system")
        if rows[0].robot is None:
            if not names:
                raise IpsysError(f"{path}: names no robot; add --robot NAME for this file")
            name = names.pop(0)
            rows = [row._replace(robot=name) for row in rows]
        for one in _paths_of(path, rows):
            if one.robot in found:
                raise IpsysError(f"{path}: robot {one.robot!r} has a path already; give one file for a robot")
            found[one.robot] = one
    if names:
        raise IpsysError(f"--robot {names[0]}: no file is left for it; give one name for each file without")
    return list(found.values())


def parse_offset(text: str) -> int:
    """Return the time offset of the option ``--time-offset``, from s to ns.

    Raises
    ------
    IpsysError
        The text is no number.

    Examples
    --------
    >>> parse_offset("-1.25")
    -1250000000
    """
    return _time_ns(text, NS_PER_S, "--time-offset")


def _read_rows(path: Path, units: TruthUnits) -> list[_Row]:
    suffix = path.suffix.lower()
    read = {".csv": _csv_rows, ".tum": _tum_rows, ".txt": _tum_rows}.get(suffix)
    if read is None:
        raise IpsysError(f"{path}: the format is not known; use a .csv table or a .tum trajectory")
    with open_as_text(path):
        return list(read(path, units))


def _paths_of(path: Path, rows: Sequence[_Row]) -> Iterator[TruthPath]:
    by_robot: dict[str, list[_Row]] = defaultdict(list)
    for row in rows:
        by_robot[str(row.robot)].append(row)
    for robot, own in by_robot.items():
        for before, row in pairwise(own):
            if row.time_ns <= before.time_ns:
                raise IpsysError(
                    f"{path}: line {row.line}: the time of robot {robot!r} is not after that of line "
                    f"{before.line}; sort the rows by time, and remove doubled ones"
                )
        yield TruthPath(
            robot,
            np.array([row.time_ns for row in own], dtype=np.int64),
            np.array([row.point_m for row in own], dtype=np.float64),
            np.array([row.forward for row in own], dtype=np.float64),
        )


def _tum_rows(path: Path, _: TruthUnits) -> Iterator[_Row]:
    with path.open(encoding="utf-8-sig") as file:
        for number, text in enumerate(file, 1):
            cells = text.split("#", 1)[0].split()
            if not cells:
                continue
            where = f"{path}: line {number}"
            if len(cells) != _TUM_FIELDS:
                raise IpsysError(
                    f"{where}: has {len(cells)} numbers, not {_TUM_FIELDS}; a line of TUM is "
                    "timestamp tx ty tz qx qy qz qw"
                )
            x_m, y_m, z_m, *quaternion = (_number(cell, where) for cell in cells[1:])
            time_ns = _time_ns(cells[0], TIME_UNITS["s"], where)
            yield _Row(None, time_ns, (x_m, y_m, z_m), _forward_of(quaternion, where), number)


class _Columns(NamedTuple):
    """The places of the columns in a row, and the factors of their units.

    ``ticks_ns`` is None for times in ISO 8601. ``quaternion`` or ``heading`` is empty if it is missing.
    """

    time: int
    ticks_ns: int | None
    axes: tuple[int, ...]
    per_m: tuple[float, ...]
    robot: int | None
    quaternion: tuple[int, ...]
    heading: tuple[int, float] | None


def _csv_rows(path: Path, units: TruthUnits) -> Iterator[_Row]:
    table = read_cells(path)
    columns = _find_columns(path, next(table)[1], units)
    for line, cells in table:
        if all(not cells[place].strip() for place in columns.axes):
            continue  # the other system did not see the robot
        yield _csv_row(cells, columns, f"{path}: line {line}", line)


def _csv_row(cells: Sequence[str], columns: _Columns, where: str, line: int) -> _Row:
    text = cells[columns.time].strip()
    if columns.ticks_ns is not None:
        time_ns = _time_ns(text, columns.ticks_ns, where)
    else:
        try:
            time_ns = parse_time(text)
        except ValueError as error:
            raise IpsysError(
                f"{where}: {text[:40]!r} is not a time in ISO 8601; for numbers, name the column time_s or "
                "time_ns, or add --time-unit s"
            ) from error
    x_m, y_m, z_m = (
        _number(cells[place], where) / per_m for place, per_m in zip(columns.axes, columns.per_m, strict=True)
    )
    robot = cells[columns.robot].strip() if columns.robot is not None else None
    if robot == "":
        raise IpsysError(f"{where}: names no robot; fill the column, or remove it and add --robot NAME")
    return _Row(robot, time_ns, (x_m, y_m, z_m), _csv_forward(cells, columns, where), line)


def _csv_forward(cells: Sequence[str], columns: _Columns, where: str) -> tuple[float, float, float]:
    if columns.quaternion and any(cells[place].strip() for place in columns.quaternion):
        return _forward_of([_number(cells[place], where) for place in columns.quaternion], where)
    if columns.heading is not None and cells[columns.heading[0]].strip():
        heading_rad = _number(cells[columns.heading[0]], where) * columns.heading[1]
        return float(np.cos(heading_rad)), float(np.sin(heading_rad)), 0.0
    return _UNKNOWN


def _find_columns(path: Path, header: Sequence[str], units: TruthUnits) -> _Columns:
    places: dict[str, tuple[int, str | None]] = {}
    for place, text in enumerate(header):
        if match := _COLUMN.fullmatch(text.strip().lower()):
            # log_time_ns and other columns of an exported table have longer names, and do not match.
            places.setdefault(match["name"], (place, match["unit"]))
    time = next((places[name] for name in _TIME_NAMES if name in places), None)
    missing = [name for name in _AXES if name not in places] + (["time"] if time is None else [])
    if time is None or missing:
        raise IpsysError(
            f"{path}: the header has no column {', '.join(missing)}; name the columns like time_s, robot, "
            "x_m, y_m, z_m (or time_ns, x_mm)"
        )
    ticks = time[1] or units.time
    if ticks is not None and ticks not in TIME_UNITS:
        raise IpsysError(f"{path}: the time column has the unit {ticks!r}; use s or ns")
    scales = [_length_scale(path, name, places[name][1] or units.length) for name in _AXES]
    quaternion = tuple(places[name][0] for name in _QUATERNION if name in places)
    return _Columns(
        time[0],
        None if ticks is None else TIME_UNITS[ticks],
        tuple(places[name][0] for name in _AXES),
        tuple(scales),
        places["robot"][0] if "robot" in places else None,
        quaternion if len(quaternion) == len(_QUATERNION) else (),
        _heading_column(path, places),
    )


def _length_scale(path: Path, name: str, unit: str | None) -> float:
    if unit not in LENGTH_UNITS:
        raise IpsysError(
            f"{path}: the unit of column {name} is not known; write {name}_m or {name}_mm, "
            "or add --length-unit m"
        )
    return LENGTH_UNITS[unit]


def _heading_column(path: Path, places: Mapping[str, tuple[int, str | None]]) -> tuple[int, float] | None:
    if "heading" not in places:
        return None
    place, unit = places["heading"]
    scales = {"rad": 1.0, "deg": float(np.pi / 180)}
    if unit not in scales:
        raise IpsysError(f"{path}: the unit of column heading is not known; write heading_rad or heading_deg")
    return place, scales[unit]


def _forward_of(quaternion: Sequence[float], where: str) -> tuple[float, float, float]:
    """Return the x axis of a body with the quaternion (x, y, z, w)."""
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise IpsysError(f"{where}: the quaternion has the length {length:g}, not 1; check the columns")
    x, y, z, w = (value / length for value in quaternion)
    return 1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)


def _number(text: str, where: str) -> float:
    return parse_number(text, where, "leave a missing position empty")


def _time_ns(text: str, tick_ns: int, where: str) -> int:
    """Return a time in ns with all its digits, which a float cannot hold."""
    try:
        value = Decimal(text) * tick_ns
    except ArithmeticError:
        value = Decimal("nan")
    if not value.is_finite() or abs(value) > _LATEST_NS:
        unit = "s" if tick_ns == NS_PER_S else "ns"
        raise IpsysError(f"{where}: {text.strip()[:40]!r} is not a time in {unit}; write a number")
    return round(value)
