"""Export of logs to files for other programs: tables, trajectories, ROS 2 bags, videos and data sets."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.export import TRAJECTORIES
from ipsys_log.extras import check_installed
from ipsys_log.log.dataset import Session
from ipsys_log.messages import TRUTH_TOPIC
from ipsys_log.messages.channels import CAMERA_POINTS, CHANNELS, ESTIMATE, MARKERS, TRACKS, Channel
from ipsys_log.plain_text import join_names
from ipsys_log.statistics.ground_truth import PosePairs, gather_paths, pose_pairs
from ipsys_log.tools.comparison import read_comparisons


class Export(NamedTuple):
    """An exported file or folder.

    It has its path, the number of its rows, their runs, and a text on the rows, such as ``rows of tracks``.
    """

    path: Path
    rows: int
    runs: tuple[str, ...]
    content: str = "rows"


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """The wishes of the user.

    Attributes
    ----------
    table : the name of a table; only tables and trajectories have one.
    robot : only this robot.
    with_images : put the images into a bag.
    rate_hz, size_px : frames per second, and width and height, of a video.
    trim : write a trajectory and its ground truth, both at the instants that both have.
    """

    table: str = TRACKS.name
    robot: str | None = None
    with_images: bool = True
    rate_hz: float = 25.0
    size_px: tuple[int, int] = (1280, 720)
    trim: bool = False


Runs = Sequence[str | None]


def _write_table(
    session: Session, runs: Runs, path: Path, options: ExportOptions, _: Progress
) -> tuple[int, str]:
    from ipsys_log.exchange.export import export_file, export_pairs

    if options.trim:
        rows, true_path = export_pairs(_pose_pairs(session, runs[0], path, options), path)
        return rows, f"poses of {options.table}, and {true_path} with their ground truth"
    rows = export_file(session, options.table, runs, path, options.robot)
    return rows, f"rows of {options.table}"


def _pose_pairs(session: Session, run: str | None, path: Path, options: ExportOptions) -> PosePairs:
    """Return the poses of a robot in a run with the true ones: the tracks are those of an estimate."""
    found: dict[str, PosePairs] = {}
    if options.table == ESTIMATE.name:
        found = {one.robot: one.score.pairs for one in read_comparisons(session) if one.record.run == run}
    elif options.table == TRACKS.name:
        true, tracks = (
            {one.robot: one for one in gather_paths(session.messages(topics)).values()}
            for topics in ([TRUTH_TOPIC], session.topics(TRACKS, run))
        )
        found = {name: pose_pairs(path, true[name]) for name, path in tracks.items() if name in true}
    names = [name for name in sorted(found) if options.robot in (None, name)]
    if len(names) != 1:
        raise IpsysError(
            f"{path}: --trim needs one robot with {TRACKS.name} and a ground truth, or with an "
            f"{ESTIMATE.name}; choose it with --table and --robot (in {options.table} of run {run}: "
            f"{join_names(sorted(found)) or 'none'})"
        )
    return found[names[0]]


def _write_bag(
    session: Session, runs: Runs, path: Path, options: ExportOptions, progress: Progress
) -> tuple[int, str]:
    from ipsys_log.sinks.ros2_bag import write_bag

    robots = () if options.robot is None else (options.robot,)
    counts = write_bag(session, str(runs[0]), path, robots, options.with_images, progress)
    text = f"messages; images: {counts.images}, poses: {counts.poses}"
    if counts.left_out:
        text += f", left out: {counts.left_out} (outside the calibrated volume, predicted or without heading)"
    return counts.messages, text


def _write_video(
    session: Session, runs: Runs, path: Path, options: ExportOptions, progress: Progress
) -> tuple[int, str]:
    from ipsys_log.sinks.video.mp4 import write_video

    counts = write_video(
        session, str(runs[0]), path, options.robot, options.rate_hz, options.size_px, progress
    )
    return counts.frames, f"frames, {counts.duration_s:.1f} s"


def _write_data_set(
    session: Session, runs: Runs, path: Path, _: ExportOptions, progress: Progress
) -> tuple[int, str]:
    from ipsys_log.exchange.coco import write_coco

    counts = write_coco(session, str(runs[0]), path, progress)
    return counts.pictures, f"pictures; markers: {counts.markers}"


Write = Callable[[Session, Runs, Path, ExportOptions, Progress], tuple[int, str]]


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A format: the suffix of its files (None: a folder), its channel (None: that of the table), its writer.

    ``text`` names the format in errors, and ``libraries`` the optional modules that it needs.
    """

    text: str
    suffix: str | None
    channel: Channel | None
    write: Write
    libraries: tuple[str, ...] = ()

    def check(self, path: Path, options: ExportOptions, runs: Runs) -> None:
        """Check that the options fit the format.

        Raises
        ------
        IpsysError
            The format has no tables or robots, or has one run; its library is missing.
        """
        for library in self.libraries:
            check_installed(f"{self.text} needs", library)
        if options.trim and (self.suffix not in TRAJECTORIES or len(runs) > 1):
            raise IpsysError(f"{path}: --trim needs one run, and a name in {' or '.join(TRAJECTORIES)}")
        if self.channel is None:
            return
        if options.table != TRACKS.name:
            raise IpsysError(f"{path}: {self.text} has no table {options.table}; leave --table out")
        if options.robot is not None and self.channel is not TRACKS:
            raise IpsysError(f"{path}: {self.text} has no robots; leave --robot out")
        if len(runs) > 1:
            raise IpsysError(f"{path}: {self.text} has one run; choose one with --run")


# By the name of the option --format.
EXPORT_FORMATS = {
    "csv": ExportFormat("a CSV file", ".csv", None, _write_table),
    "parquet": ExportFormat("a Parquet file", ".parquet", None, _write_table),
    "tum": ExportFormat("a TUM trajectory", ".tum", None, _write_table),
    "kitti": ExportFormat("a KITTI trajectory", ".kitti", None, _write_table),
    "ros2": ExportFormat("a ROS 2 bag", ".mcap", TRACKS, _write_bag, ("rosbags",)),
    "mp4": ExportFormat("a video", ".mp4", TRACKS, _write_video, ("av", "matplotlib")),
    "coco": ExportFormat("a COCO data set", None, MARKERS, _write_data_set),
}


def find_format(path: Path, name: str | None) -> ExportFormat:
    """Return the format with a name; without a name, that of the suffix of the file.

    Raises
    ------
    IpsysError
        There is no such format, or its files have another suffix.
    """
    if name is not None and name not in EXPORT_FORMATS:
        raise IpsysError(f"--format {name}: is not known; use one of {', '.join(EXPORT_FORMATS)}")
    suffix = path.suffix.lower()
    if name is None:
        fitting = [row for row in EXPORT_FORMATS.values() if row.suffix == suffix]
        if not fitting:
            known = ", ".join(str(row.suffix) for row in EXPORT_FORMATS.values() if row.suffix)
            raise IpsysError(
                f"{path}: the format is not known; use a name that ends in {known}, "
                "or --format coco for a folder"
            )
        return fitting[0]
    found = EXPORT_FORMATS[name]
    if found.suffix is not None and found.suffix != suffix:
        raise IpsysError(f"--format {name}: its files end in {found.suffix}, but -o is {path}")
    return found


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height in px of a text such as ``1280x720``.

    Raises
    ------
    IpsysError
        The text has another form.
    """
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text, re.ASCII)
    if match is None:
        raise IpsysError(f"--size {text}: is not a size; write the width and the height, such as 1280x720")
    return int(match[1]), int(match[2])


def channel_of_table(name: str) -> Channel:
    """Return the channel of a table.

    Raises
    ------
    IpsysError
        There is no such table.
    """
    from ipsys_log.exchange.data_frames import TABLES

    if name not in TABLES:
        raise IpsysError(f"table {name!r} is not known; use one of {', '.join(TABLES)}")
    if name == "pairs":  # camera points, each with the measurement of its point
        return CAMERA_POINTS
    return next(channel for channel in CHANNELS if channel.name == name)
