"""Tables of poses: the columns that a layout names, and the rows of each body as a trajectory."""

import csv
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.image_folders import parse_time
from ipsys_log.exchange.row_files import with_decimal_point
from ipsys_log.messages import Array
from ipsys_log.statistics.trajectories import Trajectory
from ipsys_log.units import CM_PER_M, MM_PER_M, NS_PER_S

TIME_UNITS = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1}
LENGTH_UNITS = {"m": 1.0, "cm": CM_PER_M, "mm": MM_PER_M}
ANGLE_UNITS = {"rad": 1.0, "deg": float(np.pi / 180)}
Row = tuple[int, list[str]]
_MISSING = frozenset(("", "-", "--", "na", "n/a", "null", "none", "nan(ind)", "-nan(ind)"))
_LATEST_NS, _MOST_FRAMES = 1 << 62, 1e9
# A quaternion with another length is no rotation.
_UNIT_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class BodyColumns:
    """The columns of a body.

    Attributes
    ----------
    point : the columns of x and y, or of x, y and z.
    per_m : by axis, the unit of the column: 1000 for mm.
    turn : the columns of the rotation; empty if there is none.
    form : ``quaternion`` (x y z w), ``matrix`` (9, by rows), ``vector`` (axis times angle), ``heading``, or
        the axes of angles as scipy writes them: ``xyz`` for roll, pitch and yaw, ``XYZ`` for turned axes.
    per_rad : by angle, its unit in rad.
    """

    name: str
    point: tuple[int, ...]
    per_m: tuple[float, ...]
    turn: tuple[int, ...] = ()
    form: str = "quaternion"
    per_rad: tuple[float, ...] = (1.0,)


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of a table, and what is known of all its rows.

    Attributes
    ----------
    bodies : the columns of each body.
    time : the columns of the time, or of seconds and nanoseconds; empty: rows in steps of 1 / `rate_hz`.
    tick_ns : the unit of the time in ns; None for times in ISO 8601.
    rate_hz : the rate of the rows; with a column `time` of frames, they count from `first`.
    label : the column with the name of the body.
    is_y_up : the format has its y axis up.
    is_zero_lost : a position of zeros means that the body was not seen.
    """

    bodies: tuple[BodyColumns, ...]
    time: tuple[int, ...] = ()
    tick_ns: int | None = None
    rate_hz: float | None = None
    first: int = 0
    label: int | None = None
    is_y_up: bool = False
    is_zero_lost: bool = False


class Reading(NamedTuple):
    """The trajectories of a file; its format, rate and start, and the meaning of its columns, as texts."""

    trajectories: list[Trajectory]
    kind: str
    columns: Sequence[str]
    remarks: tuple[str, ...] = ()


@dataclass(slots=True)
class _Poses:
    """The rows of a body while they are read."""

    columns: BodyColumns
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    points: "array[float]" = field(default_factory=lambda: array("d"))
    turns: "array[float]" = field(default_factory=lambda: array("d"))


def read_poses(path: Path, rows: Iterator[Row], layout: Layout) -> list[Trajectory]:
    """Return the poses of each body of a table, without the bodies that have none."""
    by_name = {body.name: _Poses(body) for body in layout.bodies if layout.label is None}
    places = sorted({place for body in layout.bodies for place in (*body.point, *body.turn)})
    most = max((*places, *layout.time, layout.label or 0))
    for number, (line, some) in enumerate(rows):
        where = f"{path}: line {line}"
        cells = some if len(some) > most else [*some, *[""] * (most + 1 - len(some))]
        values = {place: _number(cells[place], where) for place in places}
        if not any(cell.strip() for cell in cells):
            continue
        # A row without a pose needs no valid time.
        is_lost = all(np.isnan(values[place]) for body in layout.bodies for place in body.point)
        time_ns = 0 if is_lost else _row_time_ns(cells, number, layout, where)
        if layout.label is not None:
            name = cells[layout.label].strip()
            if not name:
                raise IpsysError(
                    f"{where}: names no robot; fill the column, or remove it and add --robot NAME"
                )
            by_name.setdefault(name, _Poses(layout.bodies[0]))
        for poses in by_name.values() if layout.label is None else (by_name[name],):
            poses.times_ns.append(time_ns)
            poses.points.extend(values[place] for place in poses.columns.point)
            poses.turns.extend(values[place] for place in poses.columns.turn)
    made = (_trajectory(path, name, poses, layout) for name, poses in by_name.items())
    return [one for one in made if len(one.times_ns)]


def _trajectory(path: Path, name: str, poses: _Poses, layout: Layout) -> Trajectory:
    columns = poses.columns
    count, axes = len(poses.times_ns), len(columns.point)
    points_m = np.zeros((count, 3))  # a table without z is one of poses on the floor
    points_m[:, :axes] = np.array(poses.points).reshape(count, axes) / columns.per_m
    if layout.is_zero_lost:
        points_m[(points_m == 0).all(axis=1)] = np.nan
    turns = np.array(poses.turns).reshape(count, len(columns.turn))
    quaternions = quaternions_of(turns, columns.form, columns.per_rad)
    if layout.is_y_up:
        points_m, quaternions = z_up(points_m), z_up(quaternions)
    times_ns = np.array(poses.times_ns, dtype=np.int64)
    return make_trajectory(f"{path}", name, times_ns, points_m, quaternions if columns.turn else None)


def make_trajectory(
    where: str,
    name: str,
    times_ns: NDArray[np.int64],
    points_m: Array,
    quaternions: Array | None,
    covariances: Array | None = None,
) -> Trajectory:
    """Return the poses in the order of their times, without rows that are none; see `Trajectory.left_out`."""
    turns = np.full((len(times_ns), 4), np.nan) if quaternions is None else quaternions.copy()
    lengths = np.linalg.norm(turns, axis=1)
    turns[~(np.abs(lengths - 1) <= _UNIT_TOLERANCE)] = np.nan
    is_usable = np.isfinite(lengths) & (lengths > 0)
    if is_usable.any() and abs((middle := float(np.median(lengths[is_usable]))) - 1) > _UNIT_TOLERANCE:
        body = f" of {name}" if name else ""
        raise IpsysError(f"{where}: the quaternion{body} has the length {middle:g}, not 1; check the columns")
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    # A lost body has zeros in all columns of its pose.
    is_lost = ~np.isfinite(points_m).all(axis=1) | ((points_m == 0).all(axis=1) & (lengths == 0))
    rows = np.flatnonzero(~is_lost)
    is_early = times_ns[rows] < np.maximum.accumulate(times_ns[rows])
    rows = rows[np.argsort(times_ns[rows], kind="stable")]
    starts = np.flatnonzero(np.append(True, np.diff(times_ns[rows]) > 0)) if len(rows) else rows
    kept = rows[starts]
    first = np.repeat(kept, np.diff(starts, append=len(rows)))  # of the rows of the same time
    same = (points_m[rows] == points_m[first]).all(axis=1)
    same &= ((turns[rows] == turns[first]) | np.isnan(turns[first])).all(axis=1)
    reasons = {
        "without a position": int(is_lost.sum()),
        "doubled": int(same.sum()) - len(kept),
        "with another pose at the same time": int((~same).sum()),
        "not in the order of time (sorted)": int(is_early.sum()),
    }
    if quaternions is not None:
        reasons["without a rotation"] = int(np.isnan(turns[kept, 0]).sum())
    return Trajectory(
        name,
        times_ns[kept],
        points_m[kept],
        turns[kept],
        None if covariances is None else covariances[kept],
        tuple((reason, count) for reason, count in reasons.items() if count),
    )


def quaternions_of(turns: Array, form: str, per_rad: Sequence[float] = (1.0,)) -> Array:
    """Return rotations (n, k) of a form of `BodyColumns` as quaternions (n, 4); NaN where there is none."""
    from scipy.spatial.transform import Rotation

    if form == "quaternion" and turns.shape[1]:
        return turns
    quaternions = np.full((len(turns), 4), np.nan)
    is_known = np.asarray(np.isfinite(turns).all(axis=1))
    if not turns.shape[1] or not is_known.any():
        return quaternions
    turns = turns[is_known]
    scale = np.array(per_rad)
    if form == "matrix":
        matrices = turns.reshape(-1, 3, 3)
        is_turn = np.abs(np.linalg.det(matrices) - 1) < 0.1
        is_known[np.flatnonzero(is_known)] = is_turn
        rotations = Rotation.from_matrix(matrices[is_turn])
    elif form == "vector":
        rotations = Rotation.from_rotvec(turns * scale)
    elif form == "heading":
        rotations = Rotation.from_rotvec(turns * scale * np.array([0.0, 0.0, 1.0]))
    else:
        rotations = Rotation.from_euler(form, turns * scale)
    quaternions[is_known] = rotations.as_quat()
    return quaternions


def z_up(values: Array) -> Array:
    """Return points, or quaternions x y z w, of axes with y up in axes with z up."""
    turned = values.copy()
    turned[:, 1], turned[:, 2] = -values[:, 2], values[:, 1]
    return turned


def split_rows(path: Path, delimiter: str | None) -> Iterator[Row]:
    """Yield line number and cells of each row of a text file; without a delimiter, blanks separate cells."""
    with path.open(newline="", encoding=encoding_of(path)) as file:
        if delimiter is None:
            yield from ((number, line.split()) for number, line in enumerate(file, 1))
            return
        table = csv.reader(file, delimiter=delimiter)
        for cells in table:
            yield table.line_num, cells


def encoding_of(path: Path) -> str:
    """Return the encoding of a text file by its first bytes; programs for Windows write UTF-16 and cp1252."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        head[:-3].decode("utf-8-sig")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def parse_offset(text: str) -> int:
    """Return the time offset of the option ``--time-offset``, from s to ns.

    Examples
    --------
    >>> parse_offset("-1.25")
    -1250000000
    """
    return parse_time_ns(text, NS_PER_S, "--time-offset")


def parse_pivot(text: str) -> tuple[float, float, float]:
    """Return the pivot of the option ``--pivot``, (3,) in m.

    Examples
    --------
    >>> parse_pivot("-0.15,0,0")
    (-0.15, 0.0, 0.0)
    """
    try:
        x_m, y_m, z_m = (float(part) for part in text.split(","))
    except ValueError:
        raise IpsysError(
            f"--pivot {text}: is not x,y,z in m; write three numbers, such as -0.15,0,0"
        ) from None
    return x_m, y_m, z_m


def parse_time_ns(text: str, tick_ns: int, where: str) -> int:
    """Return a time in ns with all its digits, which a float cannot hold."""
    try:
        value = Decimal(with_decimal_point(text)) * tick_ns
    except ArithmeticError:
        value = Decimal("nan")
    if not value.is_finite() or abs(value) > _LATEST_NS:
        unit = next(name for name, ticks in TIME_UNITS.items() if ticks == tick_ns)
        raise IpsysError(f"{where}: {text.strip()[:40]!r} is not a time in {unit}; write a number")
    return round(value)


def _row_time_ns(cells: Sequence[str], number: int, layout: Layout, where: str) -> int:
    texts = [cells[place].strip() for place in layout.time]
    if layout.rate_hz is not None:
        frame = number if not texts else _number(texts[0], where) - layout.first
        if not abs(frame) < _MOST_FRAMES:
            raise IpsysError(f"{where}: {texts[0]!r} is not the number of a frame; write one")
        return round(frame * NS_PER_S / layout.rate_hz)
    if layout.tick_ns is not None:
        time_ns = parse_time_ns(texts[0], layout.tick_ns, where)
        return time_ns + (parse_time_ns(texts[1], 1, where) if texts[1:] else 0)
    try:
        return parse_time(texts[0])
    except ValueError as error:
        raise IpsysError(
            f"{where}: {texts[0][:40]!r} is not a time in ISO 8601; for numbers, name the column time_s or "
            "time_ns, or add --time-unit s"
        ) from error


def _number(text: str, where: str) -> float:
    """Return the number of a cell; NaN if it is empty, or names no number."""
    try:
        value = float(text)
    except ValueError:
        if text.strip().lower() in _MISSING:
            return np.nan
        try:
            value = float(with_decimal_point(text))
        except ValueError:
            raise IpsysError(
                f"{where}: {text.strip()[:40]!r} is not a number; leave a missing position empty"
            ) from None
    return value
