"""Cut of a part of a log: ``ipsys cut``."""

from __future__ import annotations

from typing import Annotated, Optional

import typer

from ipsys_log.cli.console import console, progress_bar
from ipsys_log.cli.options import NewLog, Overwrite, ReadLogs

_TIME = "UTC, such as '2026-05-04 10:00:00', or seconds from the start of the log."


def add_commands(app: typer.Typer) -> None:
    app.command()(cut)


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
