"""Trajectories of other systems as they write them: tables, motion capture files and ROS bags."""

import csv
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.motion_capture_files import read_c3d, read_motion_capture
from ipsys_log.exchange.row_files import find_delimiter, open_as_text
from ipsys_log.exchange.trajectory_columns import (
    Column,
    GivenUnits,
    attribute_columns,
    epoch_unit_of,
    is_unit_length,
    refuse_columns,
    sample_numbers,
    time_unit_of,
)
from ipsys_log.exchange.trajectory_tables import (
    TIME_UNITS,
    BodyColumns,
    Layout,
    Reading,
    Row,
    encoding_of,
    make_trajectory,
    quaternions_of,
    read_poses,
    split_rows,
)
from ipsys_log.extras import check_installed
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array
from ipsys_log.messages.channels import TRACKS
from ipsys_log.plain_text import join_names, shell_words
from ipsys_log.statistics.ground_truth import gather_paths, last_poses
from ipsys_log.statistics.trajectories import Trajectory

_SAMPLE_ROWS = 2000
_MOST_NAMES = 8
_TUM_FIELDS, _KITTI_FIELDS = 8, 12
_TABLES = (".csv", ".tsv", ".trc", ".tum", ".txt", ".dat", ".kitti")
_COMMENTS = ("#", "%")


@dataclass(frozen=True, slots=True)
class Wanted:
    """The parts of a file that are read.

    Attributes
    ----------
    bodies : names of bodies, topics of a bag (``/odom``), or frames (``/tf:map.base_link``); empty: those of
        the file, if it is clear which.
    units : the units of columns whose header has none.
    """

    bodies: tuple[str, ...] = ()
    units: GivenUnits | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryFile:
    """The trajectories of a file, two lines on what was understood, and remarks on its rows."""

    path: Path
    trajectories: tuple[Trajectory, ...]
    understood: tuple[str, str]
    remarks: tuple[str, ...] = ()


def read_trajectories(
    path: Path, wanted: Wanted | None = None, progress: Progress = lambda step, done, total: None
) -> TrajectoryFile:
    """Read the trajectories of the bodies of a file, in the coordinates and the clock of the file.

    Raises
    ------
    IpsysError
        The file cannot be read, its format or its columns are not known, it has no poses, or none of a wanted
        body.
    """
    wanted = wanted or Wanted()
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in (".bag", ".db3", ".mcap"):
        found = (suffix == ".mcap" and _read_log(path)) or _read_bag(path, wanted.bodies, progress)
    elif suffix == ".c3d":
        found = read_c3d(path, wanted.units or GivenUnits())
    elif suffix not in _TABLES:
        raise IpsysError(
            f"{path}: the format is not known; use a table ({', '.join(_TABLES)}), C3D or a bag of ROS"
        )
    else:
        with open_as_text(path):
            units = wanted.units or GivenUnits()
            found = read_motion_capture(path, wanted.bodies, units) or _read_table(path, units)
    trajectories = tuple(found.trajectories)
    if not trajectories:
        raise IpsysError(f"{path}: has no positions; export it again from the other system")
    names = join_names([one.name for one in trajectories if one.name], _MOST_NAMES)
    counts = join_names(list(dict.fromkeys(str(len(one.times_ns)) for one in trajectories)), _MOST_NAMES)
    bodies = f"; bodies: {names}" if names else ""
    understood = f"{path.name}: {found.kind}{bodies}; poses: {counts}", "; ".join(found.columns)
    rows: Counter[str] = Counter()
    for one in trajectories:
        rows.update(dict(one.left_out))
    counted = ", ".join(f"{count} {reason}" for reason, count in rows.items())
    remarks = *found.remarks, *[f"rows: {counted}"] * bool(rows)
    return TrajectoryFile(path, trajectories, understood, remarks)


def _read_bag(path: Path, bodies: Sequence[str], progress: Progress) -> Reading:
    check_installed("bags of ROS need", "rosbags")
    from ipsys_log.exchange.ros_trajectories import read_bag_trajectories

    return read_bag_trajectories(path, bodies, progress)


def _read_log(path: Path) -> Reading | None:
    """Read the tracks of the newest run of a log of ipsys; None if the file has none."""
    with Session([path]) as session:
        run = newest_run(session, TRACKS)
        paths = {} if run is None else gather_paths(session.messages(session.topics(TRACKS, run)))
    if not paths:
        return None
    trajectories = [
        make_trajectory(
            f"{path}",
            track.robot,
            track.positions.times_ns[(rows := last_poses(track.positions))],
            track.positions.points_m[rows],
            quaternions_of(track.headings_rad[rows, None], "heading"),
        )
        for track in sorted(paths.values(), key=lambda path: path.robot)
    ]
    return Reading(trajectories, "log of ipsys", [f"tracks of run {run}", "SI units", "heading"])


def _read_table(path: Path, units: GivenUnits) -> Reading:
    """Read a table with a header, or one whose numbers show its layout."""
    delimiter, header, rows = _open_table(path)
    sample = list(islice(rows, _SAMPLE_ROWS))
    texts = [cells for _, cells in sample]
    if header is not None:
        layout, said = attribute_columns(path, header, texts, units)
        return Reading(read_poses(path, chain(sample, rows), layout), "table", said)
    if not sample:
        raise IpsysError(f"{path}: has no positions; export it again from the other system")
    count = len(texts[0])
    if count == _KITTI_FIELDS:
        times = _read_times(path)
        sample = [(line, [next(times, ""), *row]) for line, row in sample]
        rows = ((line, [next(times, ""), *row]) for line, row in rows)
        texts = [cells for _, cells in sample]
    layout, kind, meaning = _layout_of_numbers(path, texts, delimiter, units)
    return Reading(read_poses(path, chain(sample, rows), layout), kind, [meaning])


def _open_table(path: Path) -> tuple[str | None, list[str] | None, Iterator[Row]]:
    """Return the delimiter, the header and the rows of a table."""
    comments: list[str] = []
    with path.open(encoding=encoding_of(path)) as file:
        for line in file:
            if line.strip() and not line.lstrip().startswith(_COMMENTS):
                break
            if line.strip():
                comments.append(line.strip())
        else:
            line = ""
    if not line:
        raise IpsysError(
            f"{path}: {'has no positions' if comments else 'is empty'}; export it again from the other system"
        )
    delimiter = find_delimiter(line) if set(line) & set(";\t,") else None
    rows, width = _rows(path, delimiter), len(_cells(line, delimiter))
    header: list[str] | None
    if _has_numbers(line, delimiter):
        header = _header_of(comments, width, delimiter)
    else:
        _, header = next(rows, (0, []))
    return delimiter, header, _check_widths(path, rows, width, header is not None)


def _rows(path: Path, delimiter: str | None) -> Iterator[Row]:
    for line, cells in split_rows(path, delimiter):
        if any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith(_COMMENTS):
            yield line, cells


def _check_widths(path: Path, rows: Iterator[Row], width: int, has_header: bool) -> Iterator[Row]:
    for line, cells in rows:
        while len(cells) > width and not cells[-1].strip():
            cells.pop()
        if len(cells) != width:
            other = "the header has" if has_header else "the first row has"
            raise IpsysError(f"{path}: line {line}: has {len(cells)} cells, but {other} {width}")
        yield line, cells


def _cells(line: str, delimiter: str | None) -> list[str]:
    cells = line.split() if delimiter is None else next(csv.reader([line.strip()], delimiter=delimiter))
    while cells and not cells[-1].strip():
        cells.pop()
    return cells


def _has_numbers(line: str, delimiter: str | None) -> bool:
    return bool(np.isfinite(sample_numbers([cells := _cells(line, delimiter)], len(cells))).any())


def _header_of(comments: Sequence[str], width: int, delimiter: str | None) -> list[str] | None:
    """Return the names of the columns in the last comment; None if it has another number of names."""
    text = comments[-1].lstrip("#% ") if comments else ""
    splits = [_cells(text, delimiter), re.split(r"\s{2,}|\t", text), text.split()]
    return next((names for names in splits if len(names) == width), None)


def _layout_of_numbers(
    path: Path, texts: Sequence[Sequence[str]], delimiter: str | None, units: GivenUnits
) -> tuple[Layout, str, str]:
    """Return the layout of a table without a header, its format, and the meaning of its columns."""
    values = sample_numbers(texts, len(texts[0]))
    count = values.shape[1]
    times = [cells[0] for cells in texts]
    seconds = units.time or epoch_unit_of(times) or "s"
    unit = units.time or time_unit_of(times, values[:, 0])
    point, per_m = (1, 2, 3), (1.0,) * 3
    if count == _KITTI_FIELDS + 1 and all(is_unit_length(values[:, n : n + 3]) for n in (1, 5, 9)):
        body = BodyColumns("", (4, 8, 12), per_m, (1, 2, 3, 5, 6, 7, 9, 10, 11), "matrix")
        said = "matrices of 3 x 4, by rows, in m"
        return Layout((body,), (0,), TIME_UNITS[seconds]), "KITTI", f"{said}; time in {seconds}"
    if path.suffix.lower() == ".tum" and count != _TUM_FIELDS:
        raise IpsysError(
            f"{path}: line 1: has {count} numbers, not {_TUM_FIELDS}; a line of TUM is "
            "timestamp tx ty tz qx qy qz qw"
        )
    if count == _TUM_FIELDS and delimiter in (None, "\t"):
        said = f"time in {seconds}; tx ty tz in m; qx qy qz qw"
        layout = Layout((BodyColumns("", point, per_m, (4, 5, 6, 7)),), (0,), TIME_UNITS[seconds])
        return layout, "TUM", said
    order = _quaternion_order(values) if count == _TUM_FIELDS else None
    columns = [Column(place, f"column {place + 1}", (), None) for place in range(count)]
    if order is None or unit is None:
        raise refuse_columns(path, columns, values, "has no header, and its numbers do not show its columns")
    names = " ".join(name for _, name in sorted(zip(order, ("qx", "qy", "qz", "qw"), strict=True)))
    layout = Layout((BodyColumns("", point, per_m, order),), (0,), TIME_UNITS[unit])
    return layout, "table without a header", f"by its numbers: time in {unit}; x y z in m; {names}"


def _quaternion_order(values: Array) -> tuple[int, ...] | None:
    """Return the columns of x, y, z and w in rows of time, position and quaternion; None if unclear.

    The body stays upright: two of the columns are near zero. EuRoC writes w first, most others last.
    """
    turns = values[np.isfinite(values).all(axis=1), 4:8]
    if not len(turns) or not is_unit_length(turns):
        return None
    tilts = [float(np.mean(turns[:, first] ** 2 + turns[:, first + 1] ** 2)) for first in (0, 1)]
    if min(tilts) > 0.1 or (max(tilts) < 0.1 and np.ptp(turns, axis=0).max() > 0.1):
        return None
    is_last = tilts[0] < tilts[1] or (tilts[0] == tilts[1] and abs(turns[0, 3]) > 0.5)
    return (4, 5, 6, 7) if is_last else (5, 6, 7, 4)


def _read_times(path: Path) -> Iterator[str]:
    """Return the times beside a file of KITTI, which has poses only."""
    for file in (path.with_name(f"{path.stem}_times.txt"), path.with_name("times.txt")):
        if file.is_file():
            return (cells[0] for _, cells in _rows(file, None))
    raise IpsysError(
        f"{path}: has poses of KITTI without times; put the file of the times beside it as times.txt"
    )


def selected_bodies(robots: Sequence[str]) -> tuple[str, ...]:
    """Return the bodies that the texts ``NAME=BODY`` of ``--robot`` select.

    Examples
    --------
    >>> selected_bodies(["ada=Rigid Body 0", "bob"])
    ('Rigid Body 0',)
    """
    return tuple(text.partition("=")[2] for text in robots if "=" in text)


def assign_robots(
    files: Sequence[TrajectoryFile], robots: Sequence[str], known: Collection[str]
) -> list[Trajectory]:
    """Return the trajectories of the robots of a rig, each with the name of its robot.

    Parameters
    ----------
    robots : texts of ``--robot``: ``NAME=BODY`` selects a body of a file. A plain ``NAME`` is for the next
        body whose name is not one of a robot. The other bodies of a file are left out if one is selected.
    known : the robots of the rig; empty if it names none.
    """
    chosen = dict(text.partition("=")[::2] for text in robots if "=" in text)
    names = [text for text in robots if "=" not in text]
    bodies = [(file.path, one) for file in files for one in file.trajectories]
    offered = join_names([one.name for _, one in bodies if one.name], _MOST_NAMES) or "none"
    found: dict[str, Trajectory] = {}
    for robot, name in chosen.items():
        body = next((one for _, one in bodies if one.name == name), None)
        if body is None:
            where = ", ".join(str(file.path) for file in files)
            raise IpsysError(f"{where}: has no body {name!r} for --robot {robot}; bodies: {offered}")
        found[robot] = replace(body, name=robot)
    rest = [(path, one) for path, one in bodies if one.name not in chosen.values()]
    rest = [(path, one) for path, one in rest if one.name in known] if chosen and not names else rest
    unnamed = [one for _, one in rest if not one.name or (one.name not in known and (names or known))]
    if not names and len(known) == len(unnamed) == 1:
        names = [*known]
    is_short = len(names) < len(unnamed)
    for path, one in rest:
        robot = one.name
        if any(one is other for other in unnamed):
            if robot and is_short:
                rig = ", ".join(sorted(known)) or "no robots"
                raise IpsysError(
                    f"{path}: robot {robot!r} is not known; the rig has {rig}; select a body for each robot: "
                    f"--robot {[*names, *sorted(known)][0]}={shell_words(robot)} (bodies: {offered})"
                )
            if not names:
                raise IpsysError(f"{path}: names no robot; add --robot NAME for this file")
            robot = names.pop(0)
        if robot in found:
            raise IpsysError(f"{path}: robot {robot!r} has a path already; give one file for a robot")
        found[robot] = replace(one, name=robot)
    if names:
        raise IpsysError(f"--robot {names[0]}: no file is left for it; give one name for each file without")
    return list(found.values())
