"""Opened logs: several files read as one, with their tables and the tracks of robots at any times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import datetime
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from ipsys_log.api.log_export import Export, ExportOptions, channel_of_table, find_format
from ipsys_log.api.sampled_track import SampledTrack, sample_track, time_in_ns
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.engine.states import recorded_stages
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation, LogUrl, is_one_of
from ipsys_log.log.log_files import find_logs
from ipsys_log.messages import Message
from ipsys_log.messages.channels import CHANNELS, TRACKS, TRUTH, Channel
from ipsys_log.models.table import model_run
from ipsys_log.plain_text import join_names, shell_words
from ipsys_log.statistics.accuracy import root_mean_square_m
from ipsys_log.statistics.ground_truth import gather_paths, trajectory_errors
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    import pandas as pd

    from ipsys_log.api.compared_estimates import ComparedEstimates
    from ipsys_log.calibration.joint.body_calibration import BodyCalibration
    from ipsys_log.tools.soundness.finding import LogCheck

_STATISTICS = ("count", "rmse_m", "mean_m", "median_m", "std_m", "max_m", "p95_m")
_TRAJECTORY = ("robot", "metric", "delta", *_STATISTICS)

StrPath = str | PathLike[str]
Time = int | datetime


_Row = TypeVar("_Row", bound=NamedTuple)
# A longer listing prints its first and last rows: a log with all models has a hundred channels.
_MOST_LINES = 20


class Listing(tuple[_Row, ...]):
    """Rows of one kind, such as the runs of a log. It prints as a table, in notebooks too."""

    __slots__ = ()

    def __repr__(self) -> str:
        if not self:
            return "(none)"
        rows = [self[0]._fields, *(tuple(map(_cell, row)) for row in self)]
        widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]))]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        if len(lines) > _MOST_LINES:
            half = _MOST_LINES // 2
            lines[half : 1 - half] = [f"... {len(lines) - 2 * half + 1} more rows; iterate to read all"]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        if not self:
            return "<p>none</p>"
        head = "".join(f"<th>{escape(name)}</th>" for name in self[0]._fields)
        body = "".join(f"<tr>{''.join(f'<td>{escape(_cell(v))}</td>' for v in row)}</tr>" for row in self)
        return f"<table><tr>{head}</tr>{body}</table>"


def _cell(value: object) -> str:
    return "" if value is None else ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


class _CameraRow(NamedTuple):
    camera: str
    images: int
    calibrated: bool


class _RunRow(NamedTuple):
    run: str
    stage: str
    state: str
    inputs: tuple[str, ...]


class _ChannelRow(NamedTuple):
    channel: str
    run: str | None
    topic: str
    messages: int


class Log:
    """One or several logs, read as one: a snapshot of the time when they were opened. A context manager.

    Attributes
    ----------
    cameras, runs, channels : the content of the logs, as small tables.
    """

    def __init__(self, *paths: StrPath | LogUrl) -> None:
        if not paths:
            raise IpsysError("no log is given; name at least one")
        self._session = Session(find_logs(paths))

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; a second call does nothing."""
        self._session.__exit__(None, None, None)

    def __repr__(self) -> str:
        runs = len(self._session.run_names())
        names = join_names([str(path) for path in self.paths])
        return f"<Log {names}: {len(self._session.images)} cameras, {runs} runs>"

    @property
    def paths(self) -> tuple[LogLocation, ...]:
        """The paths or URLs of the logs."""
        return tuple(self._session.paths)

    @property
    def cameras(self) -> Listing[_CameraRow]:
        """The cameras: name, number of images, and whether the log has their intrinsics."""
        session = self._session
        names = sorted({*session.images, *session.calibrations})
        return Listing(
            _CameraRow(name, session.count(session.images.get(name, "")), name in session.calibrations)
            for name in names
        )

    @property
    def runs(self) -> Listing[_RunRow]:
        """The recorded stages, oldest first: run, stage, state, and the runs that they read."""
        return Listing(
            _RunRow(recorded.run.run, recorded.run.stage, recorded.state, recorded.run.input_runs)
            for recorded in recorded_stages(self._session)
        )

    @property
    def channels(self) -> Listing[_ChannelRow]:
        """The channels that have messages: name, run, topic, number of messages."""
        session = self._session
        rows = [
            _ChannelRow(channel.name, run, topic, session.count(topic))
            for channel in CHANNELS
            for run in (sorted(session.run_names()) if channel.is_derived else [None])
            for topic in session.topics(channel, run)
        ]
        return Listing(rows)

    def messages(
        self, channel: str, run: str | None = None, start: Time | None = None, end: Time | None = None
    ) -> Iterator[Message]:
        """Yield the decoded messages of a channel in log order.

        Parameters
        ----------
        channel : its name, such as ``images``, ``markers`` or ``tracks``.
        run : the run of a derived channel, or its model; None: the newest complete one.
        start, end : log times, as an integer in ns or a datetime with a time zone; the end is not included.

        Raises
        ------
        IpsysError
            There is no such channel or run.
        """
        selected = _channel_named(channel)
        topics = self._session.topics(selected, self._run_of(selected, run))
        return self._session.messages(topics, _ns(start), _ns(end))

    def table(
        self,
        name: str,
        run: str | Sequence[str] | None = None,
        start: Time | None = None,
        end: Time | None = None,
    ) -> pd.DataFrame:
        """Read a channel as a table: one row for each marker, point, position or track.

        Times are in UTC; ``time`` is the instant of the row. Missing values are NaN or NA.

        Parameters
        ----------
        name : ``markers``, ``camera_points``, ``pairs``, ``positions``, ``tracks``, ``truth``,
            ``measurements``, ``events`` or ``latency``.
        run : the run of a derived channel, or its model; None: the newest complete one; several: a column
            ``run`` names it.
        start, end : as for :meth:`messages`.

        Raises
        ------
        IpsysError
            There is no such table or run, or pandas is not installed.
        """
        from ipsys_log.exchange.data_frames import read_table

        wanted = [run] if run is None or isinstance(run, str) else list(run)
        runs = [self._run_of(channel_of_table(name), one) for one in wanted]
        return read_table(self._session, name, runs, _ns(start), _ns(end))

    def trajectory_errors(self, run: str | None = None) -> pd.DataFrame:
        """Return the errors of tracks against the ground truth of the log, by the definitions of evo.

        A row has a robot and a metric: the absolute trajectory error (``ATE 3D`` and ``ATE 2D``), without an
        alignment, or the relative pose error (``RPE``) over a distance or a time, its ``delta``. The columns
        are the number of poses or pairs, and RMSE, mean, median, standard deviation, maximum and 95th
        percentile in m.

        Parameters
        ----------
        run : a run with tracks; None: the newest complete one.

        Raises
        ------
        IpsysError
            The log has no tracks or no ground truth, or pandas is not installed.
        """
        from ipsys_log.exchange.data_frames import import_pandas

        pandas = import_pandas()
        name = self._run_of(TRACKS, run)
        assert name is not None  # tracks are a derived channel
        if not self._session.count(TRUTH.topic):
            raise IpsysError(f"{self._session}: has no ground truth; import one: ipsys import TABLE --into")
        paths = gather_paths(self._session.messages(self._session.topics(TRACKS, name)))
        true = gather_paths(self._session.messages([TRUTH.topic]))
        rows = []
        for one in trajectory_errors(paths, true):
            relative = [("RPE", f"{rpe.delta:g} {rpe.unit}", rpe.summary) for rpe in one.relative]
            metrics = [("ATE 3D", None, one.absolute_3d), ("ATE 2D", None, one.absolute_2d), *relative]
            rows += [
                {
                    **asdict(errors),
                    "robot": one.robot,
                    "metric": metric,
                    "delta": delta,
                    "rmse_m": root_mean_square_m(errors),
                }
                for metric, delta, errors in metrics
            ]
        table: pd.DataFrame = pandas.DataFrame(rows, columns=[*_TRAJECTORY])
        return table

    def compare(
        self,
        *estimates: StrPath,
        robot: str | Sequence[str] = (),
        run: str | None = None,
        topic: str | None = None,
        align: str = "2d",
        time_offset_s: float | None = None,
        pivot_m: tuple[float, float, float] | None = None,
        scale: bool = False,
    ) -> ComparedEstimates:
        """Score estimates of robots against their tracks; without estimates, those that the log stores.

        The options are those of ``ipsys compare``, which also appends the estimates to the log.

        Returns
        -------
        ComparedEstimates : two pandas tables: ``errors`` (ATE and RPE) and ``estimates``.

        Raises
        ------
        IpsysError
            An estimate cannot be read or does not fit the tracks, or pandas is not installed.
        """
        from ipsys_log.api.compared_estimates import compare_estimates
        from ipsys_log.statistics.trajectories import KnownParts
        from ipsys_log.tools.estimates import CompareOptions

        offset_ns = None if time_offset_s is None else round(time_offset_s * NS_PER_S)
        known = KnownParts(offset_ns, align, pivot_m, scale)
        names = (robot,) if isinstance(robot, str) else tuple(robot)
        options = CompareOptions(names, run and model_run(run), known, topic)
        return compare_estimates(self._session, [Path(path) for path in estimates], options)

    def calibrate_body(self, robot: str, rig: StrPath | None = None) -> BodyCalibration:
        """Estimate the poses and sides of a body's markers, as ``ipsys calibrate-body``; write nothing."""
        from ipsys_log.messages.rig_file import load_rig
        from ipsys_log.tools.carried_lab import calibrate_carried_body

        return calibrate_carried_body(self._session, robot, load_rig(Path(rig)) if rig else None)[0]

    def export(
        self,
        path: StrPath,
        table: str = "tracks",
        run: str | Sequence[str] | None = None,
        robot: str | None = None,
        *,
        format: str | None = None,
        with_images: bool = True,
        rate_hz: float = 25.0,
        size_px: tuple[int, int] = (1280, 720),
        trim: bool = False,
        progress: Progress = lambda step, done, total: None,
    ) -> Export:
        """Write a channel, or the whole log, to a file for other programs.

        Parameters
        ----------
        path : ``.csv`` or ``.parquet`` for the table; ``.tum`` or ``.kitti`` for the trajectory of a robot;
            ``.mcap`` for a ROS 2 bag; ``.mp4`` for a video; a new folder for a COCO data set.
        table, run, robot : as for :meth:`table`, only this robot; only a table may have several runs.
        format : ``csv``, ``parquet``, ``tum``, ``kitti``, ``ros2``, ``mp4`` or ``coco``; None: by the suffix.
        with_images : put the images into a bag.
        rate_hz, size_px : frames per second, and width and height, of a video.
        trim : write a trajectory, and its ground truth with ``_truth`` in the name, at the same instants.
        progress : called with the step, the number of messages done, and the number of all messages.

        Raises
        ------
        IpsysError
            There is no such format, table, run or robot; a library is missing; the file is one of the
            logs; the log has no images for a video or a data set.
        """
        file = Path(path)
        if is_one_of(file, self.paths):
            raise IpsysError(f"{file}: this is the log itself; name another file")
        found = find_format(file, format)
        options = ExportOptions(table, robot, with_images, rate_hz, size_px, trim)
        wanted = [run] if run is None or isinstance(run, str) else list(run)
        found.check(file, options, wanted)
        channel = found.channel or channel_of_table(table)
        runs = [self._run_of(channel, name) for name in wanted]
        rows, content = found.write(self._session, runs, file, options, progress)
        return Export(file, rows, tuple(name for name in runs if name is not None), content)

    def track_at(self, robot: str, times: Any, run: str | None = None) -> SampledTrack:
        """Return the poses of a robot at any times, with covariances, from its track.

        The smoothed tracks of the run are read if there are any, otherwise its tracks. Between two rows, the
        robot moves on a cubic polynomial, and the covariance contains the unknown motion.

        Parameters
        ----------
        robot : its name, such as ``robot_0``.
        times : capture times: integers in ns, datetimes with a time zone, or a pandas index or column; one or
            several.
        run : the run of the tracks; None: the newest complete one.

        Returns
        -------
        SampledTrack : NaN where the robot has no track.

        Raises
        ------
        IpsysError
            There is no such robot or run, or a time has no time zone.
        """
        return sample_track(self._session, robot, times, run and model_run(run))

    def check(self) -> tuple[LogCheck, ...]:
        """Read the logs completely and check them, as ``ipsys.check()`` does; a result for each log."""
        from ipsys_log.tools.soundness.check import check_logs

        return check_logs(self.paths)

    def _run_of(self, channel: Channel, run: str | None) -> str | None:
        if not channel.is_derived:
            if run is not None:
                raise IpsysError(f"channel {channel.name} is recorded and belongs to no run; leave run out")
            return None
        run = run and model_run(run)
        name = run or newest_run(self._session, channel)
        if name is None or not self._session.topics(channel, name):
            known = [
                name for name in sorted(self._session.run_names()) if self._session.topics(channel, name)
            ]
            which = f"run {run} has no {channel.name}" if run else f"no run has {channel.name}"
            advice = f"; compute them: ipsys replay {shell_words(self.paths[-1])}" if not known else ""
            raise IpsysError(f"{self._session}: {which} (it is in: {', '.join(known) or 'none'}){advice}")
        return name


def _channel_named(name: str) -> Channel:
    channel = next((channel for channel in CHANNELS if channel.name == name), None)
    if channel is None:
        raise IpsysError(f"channel {name!r} is not known; use one of {', '.join(c.name for c in CHANNELS)}")
    return channel


def _ns(time: Time | None) -> int | None:
    return time if time is None or isinstance(time, int) else time_in_ns(time)
