"""New logs from the messages of others: ``ipsys cut``, ``ipsys compact`` and ``ipsys merge``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from ipsys_log.cli.console import console, progress_bar, remarks
from ipsys_log.cli.options import (
    AsJson,
    LogList,
    NewLog,
    OneLog,
    Overwrite,
    ReadLogs,
    log_argument,
    log_option,
    one_log_argument,
)
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.log.location import LogLocation
    from ipsys_log.runs.compact import DroppedRun
    from ipsys_log.runs.merge import MergeResult
    from ipsys_log.runs.merge_plan import LogOffset

_TIME = "UTC, such as '2026-05-04 10:00:00', or seconds from the start of the log."


def add_commands(app: typer.Typer) -> None:
    for command in (cut, compact, merge):
        app.command()(command)


def cut(
    logs: ReadLogs,
    output: NewLog,
    start: Annotated[
        str, typer.Option(metavar="TIME", help=f"Keep messages from this time on: {_TIME}")
    ] = "",
    end: Annotated[str, typer.Option(metavar="TIME", help=f"Keep messages before this time: {_TIME}")] = "",
    topics: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            metavar="PATTERN",
            help="Keep topics of this pattern, such as '/cameras/*'; repeat it for several.",
        ),
    ] = None,
    exclude_topics: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(metavar="PATTERN", help="Leave out topics of this pattern; repeat it for several."),
    ] = None,
    cameras: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--cameras", "--camera", metavar="NAME", help="Keep this camera; repeat it for several."
        ),
    ] = None,
    runs: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--runs", "--run", metavar="NAME", help="Keep this run; repeat it for several."),
    ] = None,
    exclude_runs: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--exclude-runs",
            "--exclude-run",
            metavar="NAME",
            help="Leave out this run with its record; repeat it for several.",
        ),
    ] = None,
    robots: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--robots",
            "--robot",
            metavar="NAME",
            help="Keep the frames that show this robot, with their results; repeat it for several.",
        ),
    ] = None,
    every: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Keep each n-th frame of each camera, with its results."),
    ] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Write a part of a log to a new log: a time range, some topics, cameras, runs, robots or frames.

    The messages stay as they are. Rig, intrinsics, models, measurements and the records of runs come with
    every part. The new log names the log that it was cut from, and ipsys verify checks its messages.
    """
    from ipsys_log.runs.cut import cut as cut_logs
    from ipsys_log.runs.cut_selection import CutOptions
    from ipsys_log.units import format_bytes

    options = CutOptions(
        start=start,
        end=end,
        topics=topics or (),
        exclude_topics=exclude_topics or (),
        cameras=cameras or (),
        runs=runs or (),
        exclude_runs=exclude_runs or (),
        robots=robots or (),
        every=every,
    )
    with progress_bar() as progress:
        result = cut_logs(logs, output, options, overwrite, progress)
    console.print(
        f"{output} written: {result.kept} of {result.messages} messages, {result.channels} channels, "
        f"{format_bytes(output.stat().st_size)}"
    )


def compact(
    log: Annotated[OneLog, one_log_argument(help="A finished log, a file or a URL. It stays as it is.")],
    output: Annotated[
        Optional[Path],  # noqa: UP045
        log_option(help="The log to write, with a name that ends in .mcap."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only list the runs that would be dropped, and write nothing.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Copy a log without its superseded and unfinished runs. The other runs keep their provenance.

    A run is superseded if newer complete runs of the same name, settings and kind of input replace all its
    stages: poly_2 supersedes poly. Runs that a kept run has read are kept. Another log may have results of a
    dropped run as its input: ipsys runs lists the input runs of a log.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.log.log_files import read_log_state
    from ipsys_log.runs import compact as compaction
    from ipsys_log.runs.output import check_copy

    if output is None and not dry_run:
        raise IpsysError("-o is missing; give the name of the new log, or --dry-run")
    if output is not None:
        check_copy([log], output, overwrite)
    dropped, size = compaction.dropped_runs(log), read_log_state(log).size
    is_written = output is not None and bool(dropped) and not dry_run
    if not as_json:
        _show_dropped(log, size, dropped)
    if output is not None and is_written:
        with progress_bar() as progress:
            compaction.compact(log, output, overwrite, progress)
    if as_json:
        print(json.dumps(_compact_json(log, size, output if is_written else None, dropped), indent=2))  # noqa: T201
    elif output is not None and is_written:
        _show_saving(size, output)


def merge(
    logs: Annotated[
        LogList,
        log_argument(help="The logs of the recorders, files or URLs. The clock of the first log counts."),
    ],
    output: NewLog,
    offset: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            metavar="NAME=SECONDS",
            help="Add these seconds to all times of a log, such as monday_b=0.012; repeat it for several.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Merge the logs of several recorders of one session, with different cameras, into a new log.

    Each recorder has its own clock. Without --offset, the command estimates the offset of a log from moving
    markers that its cameras and those of an earlier log saw. Run ipsys detect on both logs first. Rigs and
    intrinsics must not contradict each other, and each run has its results in one log only: markers of other
    cameras join the run of the same name. The new log has the record of the merge with all offsets.
    """
    from ipsys_log.runs.merge import merge as merge_logs
    from ipsys_log.runs.merge_offsets import choose_offsets
    from ipsys_log.runs.output import check_copy

    check_copy(logs, output, overwrite)
    with progress_bar() as progress:
        offsets = choose_offsets(logs, offset or (), progress)
        result = merge_logs(logs, output, offsets, overwrite, progress)
    if as_json:
        print(json.dumps(_merge_json(output, result), indent=2))  # noqa: T201
        return
    _show_offsets(logs, offsets)
    from ipsys_log.units import format_bytes

    console.print(
        f"{output} written: {result.messages} messages, {format_bytes(output.stat().st_size)}", markup=False
    )
    remarks.print(f"next: ipsys replay {shell_words(output)}", markup=False)


def _show_dropped(log: LogLocation, size: int, dropped: list[DroppedRun]) -> None:
    from ipsys_log.units import format_bytes

    if not dropped:
        console.print(f"{log}: no run is superseded or unfinished; nothing is written", markup=False)
        return
    for one in dropped:
        count = "1 message" if one.messages == 1 else f"{one.messages} messages"
        stored = format_bytes(one.stored_bytes)
        console.print(f"{one.run.run} is dropped: {one.run.reason}; {count}, about {stored}", markup=False)
    gained = sum(one.stored_bytes for one in dropped)
    console.print(
        f"{len(dropped)} run{'' if len(dropped) == 1 else 's'}, about {format_bytes(gained)} of "
        f"{format_bytes(size)}",
        markup=False,
    )


def _show_saving(before: int, output: Path) -> None:
    from ipsys_log.units import format_bytes

    after = output.stat().st_size
    console.print(f"{output} written: {format_bytes(after)} instead of {format_bytes(before)}", markup=False)


def _compact_json(
    log: LogLocation, size: int, output: Path | None, dropped: list[DroppedRun]
) -> dict[str, Any]:
    return {
        "log": str(log),
        "output": None if output is None else str(output),
        "bytes": size,
        "output_bytes": None if output is None else output.stat().st_size,
        "dropped": [
            {
                "run": one.run.run,
                "reason": one.run.reason,
                "stages": one.run.stages,
                "messages": one.messages,
                "stored_bytes": one.stored_bytes,
            }
            for one in dropped
        ],
    }


def _show_offsets(logs: Sequence[LogLocation], offsets: Sequence[LogOffset]) -> None:
    for path, offset in zip(logs[1:], offsets[1:], strict=True):
        sigma = "" if offset.sigma_s is None else f" (estimated, sigma {offset.sigma_s * 1e3:.2f} ms)"
        console.print(f"{path}: {offset.offset_ns / 1e9:+.6f} s are added to its times{sigma}", markup=False)


def _merge_json(output: Path, result: MergeResult) -> dict[str, Any]:
    return {
        "output": str(output),
        "messages": result.messages,
        "logs": [
            {
                "name": one.name,
                "offset_ns": one.offset_ns,
                "offset_sigma_s": one.offset_sigma_s,
            }
            for one in result.logs
        ],
    }
