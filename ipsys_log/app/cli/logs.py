"""The content of a log, and its soundness: ``ipsys info``, ``cat``, ``check``, ``verify`` and ``repair``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import (
    console,
    print_json,
    print_outcomes,
    print_result,
    progress_bar,
    say,
    warn,
)
from ipsys_log.app.cli.options import (
    appended_log_argument,
    check_present,
    figure_option,
    log_argument,
    setting,
    switch,
)
from ipsys_log.app.cli.signals import writes_nothing
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation
from ipsys_log.plain_text import shell_words
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    from rich.console import RenderableType

    from ipsys_log.log.dataset import Session
    from ipsys_log.tools.differences import Comparison

_Seconds = float | None


@writes_nothing
def info(
    logs: cli.ReadLogs,
    runs: Annotated[
        bool, switch("--runs", "Show the runs with their inputs, parameters, versions and states.")
    ] = False,
    sizes: Annotated[
        bool, switch("--sizes", "Show the size of each channel of each log, the largest first.")
    ] = False,
    latency: Annotated[
        bool,
        switch("--latency", "Show the latency of each step of a live run, from the frame to the position."),
    ] = False,
    plot: Annotated[Path | None, figure_option("the processing steps of --latency")] = None,
    as_json: cli.AsJson = False,
) -> None:
    """Show cameras, channels, counts, rates, gaps and runs of a log.

    A run is current, out of date, not repeatable or unfinished. If it is out of date, the reason follows, and
    ipsys replay makes a new run. Inputs of a run that is not repeatable are not in the log. The writer of an
    unfinished run was stopped.

    In --sizes, the payload is counted before compression. A compressed chunk counts in proportion to the
    bytes of its messages.

    Examples

        ipsys info monday.mcap
        ipsys info monday.mcap --runs --sizes
        ipsys info monday.mcap --latency --plot latency.pdf
        ipsys info s3://lab/monday.mcap          # at a URL: docs/scale.md
    """
    if plot is not None and not latency:
        raise IpsysError(f"--plot {plot}: has no effect without --latency; add --latency")
    check_present(logs)
    parts: dict[str, Callable[[], tuple[Any, list[RenderableType]]]] = {}
    if runs:
        parts["runs"] = lambda: _runs(logs)
    if sizes:
        parts["sizes"] = lambda: _sizes(logs)
    if latency:
        parts["latency"] = lambda: _latency(logs, plot)
    shown = {name: show() for name, show in (parts or {"": lambda: _contents(logs)}).items()}
    if as_json:
        results = {name: plain for name, (plain, _) in shown.items()}
        print_json(results if len(results) > 1 else next(iter(results.values())))
        return
    for number, table in enumerate(table for _, tables in shown.values() for table in tables):
        if number:
            console.print()
        console.print(table)


def _contents(logs: Sequence[LogLocation]) -> tuple[Any, list[RenderableType]]:
    """Return the contents of a session as plain data and as tables."""
    from ipsys_log.app.report.contents import contents_json, contents_tables
    from ipsys_log.log.dataset import Session

    with Session(logs) as session:
        contents = contents_json(session)
    return contents, [*contents_tables(contents)]


def _runs(logs: Sequence[LogLocation]) -> tuple[Any, list[RenderableType]]:
    from ipsys_log.app.report.contents import runs_table, states_json
    from ipsys_log.log.dataset import Session

    with Session(logs) as session:
        states = states_json(session)
    return states, [runs_table(states)]


def _sizes(logs: Sequence[LogLocation]) -> tuple[Any, list[RenderableType]]:
    from ipsys_log.app.report.log_texts import sizes_json, sizes_table
    from ipsys_log.log.reader import LogReader

    def read(path: LogLocation) -> dict[str, Any]:
        with LogReader(path) as reader, progress_bar(()) as progress:
            sizes = reader.sizes(lambda done: progress("chunks", done, reader.chunk_count))
            return sizes_json(str(path), reader.size, sizes)

    results = [read(path) for path in logs]
    return results, [sizes_table(result) for result in results]


def _latency(logs: Sequence[LogLocation], plot: Path | None) -> tuple[Any, list[RenderableType]]:
    from dataclasses import asdict

    from ipsys_log.app.report.log_texts import latency_table
    from ipsys_log.statistics.latency import latency_percentiles, recorded_latencies, step_times_s

    times_s = step_times_s(recorded_latencies(logs))
    steps = latency_percentiles(times_s)
    if plot is not None:
        from ipsys_log.app.report.latency_figure import draw_latency

        draw_latency(times_s, plot)
        say(f"{plot} drawn")
    return {step: asdict(times) for step, times in steps.items()}, [latency_table(steps)]


@writes_nothing
def cat(
    logs: cli.ReadLogs,
    topics: Annotated[
        list[str] | None, setting("--topics", "TOPIC,...", "Print only these topics, separated by commas.")
    ] = None,
    start_secs: Annotated[
        _Seconds, setting("--start-secs", "SECONDS", "Begin at this log time since 1970, in UTC.")
    ] = None,
    end_secs: Annotated[
        _Seconds, setting("--end-secs", "SECONDS", "End before this log time since 1970, in UTC.")
    ] = None,
    start_offset: Annotated[
        _Seconds, setting("--start-offset", "SECONDS", "Begin so long after the first message.")
    ] = None,
    end_offset: Annotated[
        _Seconds, setting("--end-offset", "SECONDS", "End so long after the first message.")
    ] = None,
    as_json: cli.AsJson = False,
) -> None:
    """Print the messages of a log in log order, one line each: time (UTC), topic, schema and short content.

    With --json, each line is a JSON object with all values; images are given by their size.

    Examples

        ipsys cat monday.mcap --topics /events,/latency
        ipsys cat monday.mcap --start-offset 10 --end-offset 12 | less
        ipsys cat monday.mcap --topics /runs/poly/tracks --json > tracks.ndjson
    """
    from ipsys_log.app.report.log_texts import message_json, message_line
    from ipsys_log.log.dataset import Session

    draw = message_json if as_json else message_line
    with Session(logs) as session:
        channels = {
            topic: channel for reader in session.readers for topic, channel in reader.channels.items()
        }
        wanted = _wanted(session, topics or [])
        starts_ns = [_ns(start_secs), _ns(start_offset, session.start_ns)]
        ends_ns = [_ns(end_secs), _ns(end_offset, session.start_ns)]
        start_ns = max((time for time in starts_ns if time is not None), default=None)
        end_ns = min((time for time in ends_ns if time is not None), default=None)
        try:
            for raw, message in session.attempts(wanted, start_ns, end_ns):
                print(draw(raw, message, channels[raw.topic]))  # noqa: T201
            sys.stdout.flush()
        except BrokenPipeError:  # the reader of the pipe, such as head, has ended
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _wanted(session: Session, topics: list[str]) -> list[str]:
    """Return the topics to print: those of the options, or all that can be read."""
    known = {topic for reader in session.readers for topic in reader.channels}
    named = [topic for words in topics for topic in words.split(",") if topic]
    for topic in named:
        if topic not in known:
            raise IpsysError(
                f"{session}: has no topic {topic}; to list the topics: "
                f"ipsys info {shell_words(*session.paths)}"
            )
    return named or sorted(known)


def _ns(seconds: float | None, start_ns: int = 0) -> int | None:
    """Return the time in ns that lies `seconds` after `start_ns`; None without an option."""
    if seconds is None:
        return None
    if not 0 <= seconds < 1e10:
        raise IpsysError(f"{seconds:g} s is no time in a log; give seconds from 0 on")
    return start_ns + round(seconds * NS_PER_S)


Logs = Annotated[cli.LogList, log_argument(help="Logs, files or URLs; each one is read separately.")]


@writes_nothing
def check(
    logs: Logs,
    details: Annotated[
        bool, switch("--details", "Also print notes: rates, unknown channels, current runs.")
    ] = False,
    as_json: cli.AsJson = False,
) -> None:
    """Read logs completely and check them: file, channels, times, rates, references and runs.

    The exit code is 0 if all logs are sound, 1 if they are readable with remarks, and 2 if one is broken.
    It is 3 if none is broken, but one could not be read, such as a URL without a connection. Runs may have
    their inputs in another of the given logs.

    Examples

        ipsys check monday.mcap                  # is it sound? exit code 0 to 3
        ipsys check lab.mcap derived.mcap        # derived.mcap has runs of lab.mcap
        ipsys check *.mcap --json                # also notes, for programs
    """
    from ipsys_log.app.report.checks import check_json, check_lines
    from ipsys_log.tools.soundness.check import check_logs
    from ipsys_log.tools.soundness.finding import READABLE, SOUND, UNREAD, LogCheck

    with progress_bar(()) as progress:
        checks = check_logs(logs, progress)
    print_result(check_json(checks), [line for one in checks for line in check_lines(one, details)], as_json)
    code = {SOUND: 0, READABLE: 1, UNREAD: 3}.get(LogCheck.worst(checks), 2)
    if code:
        raise typer.Exit(code)


@writes_nothing
def verify(
    logs: Annotated[
        cli.LogList,
        log_argument(help="Logs, files or URLs, read as one session. With --compare: one or two logs."),
    ],
    run: Annotated[
        list[str] | None,
        setting("--run", "NAME", "Use only this run. With --compare, give it twice for two runs."),
    ] = None,
    compare: Annotated[
        bool,
        switch("--compare", "Compare the runs of two logs, or two runs of one log, and compute nothing."),
    ] = False,
    as_json: cli.AsJson = False,
) -> None:
    """Compute every run of a log again from its inputs, and compare each channel byte for byte.

    Frames that live processing skipped are excluded. Runs that ipsys cut or ipsys merge has copied without
    their whole inputs are compared with the hashes of the copy; the command names them. The exit code is 1 if
    there is a difference.

    Examples

        ipsys verify monday.mcap                           # all of its runs
        ipsys verify monday.mcap tuesday.mcap --compare
        ipsys verify monday.mcap --compare --run poly --run best
    """
    from ipsys_log.app.report.checks import comparison_json, comparison_table, first_difference

    why, reason = None, {}
    if compare:
        comparisons, why = _compare(logs, run or [])
        reason = {} if why is None else {"nothing_in_common": why}
    else:
        from ipsys_log.api import python_api as api

        if run and len(run) > 1:
            raise IpsysError("--run: is given twice; name one run, or add --compare to compare two")
        with progress_bar() as progress:
            comparisons = api.verify(*logs, run=run[0] if run else None, progress=progress, say=say)
    sides = ("first", "second") if compare else ("log", "again")
    difference = why or first_difference(comparisons)
    agreement = "no difference" if compare else _agreement(comparisons)
    answer = Text(difference or agreement, "green" if difference is None else "red")
    parts = (comparison_table(comparisons, sides), answer)
    print_result({**comparison_json(comparisons), **reason}, parts, as_json)
    if not all(comparison.equal for comparison in comparisons):
        raise typer.Exit(1)


def _compare(logs: Sequence[LogLocation], runs: list[str]) -> tuple[list[Comparison], str | None]:
    """Compare two logs, or two runs of one log; return the reason if they have no message in common."""
    from ipsys_log.tools.verify import diff, explain_diff

    if len(runs) > 2 or len(logs) > 2:
        raise IpsysError("--compare: compares two logs, or two runs; name at most two of each")
    if len(logs) < 2 and len(runs) < 2:
        raise IpsysError(
            "there is nothing to compare with; name a second log, or give --run twice for two runs of one log"
        )
    names: list[str | None] = [*runs] or [None]
    sides = logs[0], logs[-1], (names[0], names[-1])
    comparisons = diff(*sides)
    # If a distance could be measured, they have frames in common.
    comparable = all(comparison.equal for comparison in comparisons) or any(
        comparison.rms is not None for comparison in comparisons
    )
    return comparisons, None if comparable else explain_diff(*sides)


def _agreement(comparisons: Sequence[Comparison]) -> str:
    count = sum(comparison.repeated for comparison in comparisons)
    if count == len(comparisons):
        return "the replay is identical to the log"
    return (
        f"{len(comparisons) - count} channels have the messages of the cut or the merge; the replay of "
        f"{count or 'no'} channels is identical to the log"
    )


def repair(log: Annotated[Path, appended_log_argument(help="A damaged or incomplete log.")]) -> None:
    """Repair a log: keep everything that can be read, report the losses, and complete its runs.

    A log without an end is completed in place. For any other damage, a new log replaces it. The old data are
    kept in <log>.damaged. A log that cannot be repaired is not changed. If ipsys live or record --detect was
    killed, the command also processes the recorded frames that have no results. For this it computes the
    runs again. After Ctrl-C, ipsys replay can do this instead.

    Examples

        ipsys repair monday.mcap
    """
    from ipsys_log.app.report.checks import repair_lines
    from ipsys_log.log.dataset import Session
    from ipsys_log.log.recovery import repair as repair_log

    for part in repair_lines(repair_log(log)):
        console.print(part)
    try:
        with Session([log]) as session:
            if not session.run_names():
                return  # there is no run to complete, so the stages are not imported
        from ipsys_log.live_runs.restore import finish_runs

        with progress_bar() as progress:
            print_outcomes(finish_runs(log, progress))
    except IpsysError as error:  # the log itself is complete
        warn(f"unfinished runs cannot be completed: {error}")
