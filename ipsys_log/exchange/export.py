"""Export of channels as tables (CSV, Parquet) and of a robot's path as a trajectory (TUM, KITTI)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.data_frames import read_table_parts
from ipsys_log.extras import check_installed
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Track
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import track_quaternion, track_rotation

if TYPE_CHECKING:
    import pandas as pd

    from ipsys_log.statistics.ground_truth import PosePairs

# Formats of tables, by the suffix of the file.
FORMATS = {".csv": "csv", ".parquet": "parquet"}
# Formats of trajectories, by the suffix of the file.
TRAJECTORIES = {".tum": "tum", ".kitti": "kitti"}
# Tables with robots.
_WITH_ROBOTS = ("tracks", "truth", "estimate")
# Columns with several texts in a row.
_LISTS = ("cameras", "splits")


def export_file(
    session: Session, name: str, runs: Sequence[str | None], path: Path, robot: str | None = None
) -> int:
    """Write a channel in the format of the file's suffix; return the number of rows.

    Parameters
    ----------
    path : of the new file; its suffix is one of ``FORMATS`` or ``TRAJECTORIES``.
    name : one of :data:`~ipsys_log.exchange.data_frames.TABLES`.
    runs : the runs to read, or one None for a recorded channel.
    robot : only this robot.
    """
    check_installed("export needs", "pandas")
    suffix = path.suffix.lower()
    if robot is not None and name not in _WITH_ROBOTS:
        raise IpsysError(f"{name} has no robots; leave the robot out, or export {' or '.join(_WITH_ROBOTS)}")
    if suffix in TRAJECTORIES:
        if name not in _WITH_ROBOTS:
            raise IpsysError(f"{path}: {name} is no trajectory; export it as {' or '.join(FORMATS)}")
        if len(runs) > 1:
            raise IpsysError(f"{path}: a trajectory has one run; choose one")
        return export_trajectory(session, name, runs[0], path, robot)
    if suffix == ".parquet":
        check_installed("Parquet files need", "pyarrow")
    return export_table(session, name, runs, path, robot)


def export_table(
    session: Session, name: str, runs: Sequence[str | None], path: Path, robot: str | None = None
) -> int:
    """Write a channel as a table: a row for each marker, point, position or track; return their number.

    The columns are those of :func:`~ipsys_log.exchange.data_frames.read_table`. Memory does not grow with the
    log. In CSV, a time is in ISO 8601 with nanoseconds, several cameras are separated by spaces, and a
    missing value is empty.

    Parameters
    ----------
    runs : the runs to read, or one None for a recorded channel; with several, a column names the run.
    path : of the new file; its suffix is one of ``FORMATS``.
    robot : only this robot.

    Raises
    ------
    IpsysError
        A library is missing, or no row has this robot.
    """
    write = {"csv": _write_csv, "parquet": _write_parquet}[FORMATS[path.suffix.lower()]]
    with replacement_of(path) as file:
        count = write(file, _parts(session, name, runs, robot))
        if robot is not None and not count:
            raise _unknown_robot(session, name, runs, robot)
    return count


def _parts(
    session: Session, name: str, runs: Sequence[str | None], robot: str | None
) -> Iterator[pd.DataFrame]:
    for run in runs:
        for part in read_table_parts(session, name, run):
            rows = part if robot is None else part[part["robot"] == robot]
            yield rows.assign(run=run) if len(runs) > 1 else rows


def _write_csv(file: BinaryIO, parts: Iterable[pd.DataFrame]) -> int:
    count = 0
    for number, part in enumerate(parts):
        columns = {str(name): _plain_column(str(name), part[name], " ".join) for name in part}
        text = part.assign(**columns).to_csv(index=False, header=not number, lineterminator="\n")
        file.write(text.encode())
        count += len(part)
    return count


def _plain_column(name: str, column: pd.Series[Any], join: Callable[[Iterable[str]], object]) -> Any:
    """Return a column with plain values: text for times and mappings, ``join`` of several texts."""
    if str(column.dtype).startswith("datetime64"):
        times = column.dt.tz_localize(None).to_numpy()
        texts = np.char.add(np.datetime_as_string(times, unit="ns"), "Z").astype(object)
        texts[np.isnat(times)] = None
        return texts
    if name in _LISTS:
        return [join(value) for value in column]
    if name == "distances_m":
        return [json.dumps(value) for value in column]
    return column


def _write_parquet(file: BinaryIO, parts: Iterator[pd.DataFrame]) -> int:
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    first = next(parts)
    fields = [pa.field(name, _arrow_type(str(name), str(first[name].dtype))) for name in first]
    schema = pa.schema(fields)
    count = 0
    with ParquetWriter(file, schema) as writer:
        for part in chain([first], parts):
            columns = {name: part[name] for name in part} | {
                name: _plain_column(name, part[name], list)
                for name in (*_LISTS, "distances_m")
                if name in part
            }
            rows = part.assign(**columns)
            writer.write_table(pa.Table.from_pandas(rows, schema=schema, preserve_index=False))
            count += len(part)
    return count


def _arrow_type(name: str, dtype: str) -> Any:
    """Return the type of a column in Parquet; it does not depend on the values."""
    import pyarrow as pa

    if name in _LISTS:
        return pa.list_(pa.string())
    if dtype.startswith("datetime64"):
        return pa.timestamp("ns", "UTC")
    if dtype in ("boolean", "bool"):
        return pa.bool_()
    return pa.float64() if dtype == "float64" else pa.int64() if dtype in ("int64", "Int64") else pa.string()


def export_pairs(pairs: PosePairs, path: Path) -> tuple[int, Path]:
    """Write poses and, into a second file, the true ones at the same instants; return their number.

    Parameters
    ----------
    path : of the new file; its suffix is one of ``TRAJECTORIES``. The name of the second one, which is
        returned, ends in ``_truth``.
    """
    # Late: most commands rotate nothing, and scipy takes long to load.
    from scipy.spatial.transform import Rotation

    known = pairs.part(pairs.is_turned)
    true_path = path.with_stem(f"{path.stem}_truth")
    if not len(known.times_ns):
        raise IpsysError(
            f"{path}: no pose has a heading and a ground truth; export the table as .csv instead"
        )
    for file_path, points_m, axes in (
        (path, known.points_m, known.axes),
        (true_path, known.true_m, known.true_axes),
    ):
        rows = np.concatenate([points_m, Rotation.from_matrix(axes).as_quat()], axis=1)
        starts = [f"{t // NS_PER_S}.{t % NS_PER_S:09d} " for t in known.times_ns.tolist()]
        if path.suffix.lower() == ".kitti":
            rows = np.concatenate([axes, points_m[:, :, None]], axis=2).reshape(-1, 12)
            starts = [""] * len(rows)
        lines = [
            f"{start}{' '.join(map(repr, row))}\n" for start, row in zip(starts, rows.tolist(), strict=True)
        ]
        with replacement_of(file_path) as file:
            file.write("".join(lines).encode())
    return len(known.times_ns), true_path


def export_trajectory(session: Session, name: str, run: str | None, path: Path, robot: str | None) -> int:
    """Write the path of a robot as a trajectory; return the number of poses.

    A line of TUM has the time in s and the pose (x y z qx qy qz qw) in m; a line of KITTI has the upper three
    rows of the matrix of the pose, without a time. Poses are in order of time. The last row of an instant
    counts. A row without a heading has no pose and is left out.

    Parameters
    ----------
    name : a table of tracks.
    path : of the new file; its suffix is one of ``TRAJECTORIES``.
    robot : None if the table has one robot only.

    References
    ----------
    TUM: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. KITTI: Geiger et
    al., "Are we ready for autonomous driving?", CVPR 2012.
    """
    write_line = {"tum": _tum_line, "kitti": _kitti_line}[TRAJECTORIES[path.suffix.lower()]]
    known: set[str] = set()
    poses: dict[int, Track] = {}
    for part in read_table_parts(session, name, run, with_turns=True):
        known.update(part["robot"].unique().tolist())
        if robot is None and len(known) > 1:
            raise IpsysError(f"{session}: {name} has the robots {_listed(known)}; choose one with --robot")
        rows = part if robot is None else part[part["robot"] == robot]
        rows = rows[rows["heading_rad"].notna()]
        times_ns = rows["time"].dt.tz_localize(None).to_numpy().astype(np.int64).tolist()
        values = rows[["x_m", "y_m", "z_m", "heading_rad"]].to_numpy().tolist()
        turns_rad = rows[["rx_rad", "ry_rad", "rz_rad"]].to_numpy()
        for time_ns, value, turn_rad in zip(times_ns, values, turns_rad, strict=True):
            x_m, y_m, z_m, heading_rad = value
            known_rad = turn_rad if np.isfinite(turn_rad).all() else None
            poses[time_ns] = Track("", 0, x_m, y_m, z_m, heading_rad, rotation_rad=known_rad)
    if robot is not None and robot not in known:
        raise _unknown_robot(session, name, [run], robot)
    if not poses:
        raise IpsysError(f"{session}: {name} has no row with a heading; export the table as .csv instead")
    with replacement_of(path) as file:
        file.writelines(write_line(time_ns, poses[time_ns]).encode() for time_ns in sorted(poses))
    return len(poses)


def _tum_line(time_ns: int, pose: Track) -> str:
    seconds = f"{time_ns // NS_PER_S}.{time_ns % NS_PER_S:09d}"
    return " ".join([seconds, *map(repr, (pose.x_m, pose.y_m, pose.z_m, *track_quaternion(pose)))]) + "\n"


def _kitti_line(_: int, pose: Track) -> str:
    rows = np.column_stack([track_rotation(pose), (pose.x_m, pose.y_m, pose.z_m)])
    return " ".join(map(repr, rows.ravel().tolist())) + "\n"


def _unknown_robot(session: Session, name: str, runs: Sequence[str | None], robot: str) -> IpsysError:
    known = {
        text
        for run in runs
        for part in read_table_parts(session, name, run)
        for text in part["robot"].unique().tolist()
    }
    return IpsysError(f"{session}: {name} has no robot {robot!r} (it has: {_listed(known) or 'none'})")


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))
