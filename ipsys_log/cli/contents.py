"""Commands that read all messages of a log: ``ipsys check``, ``du`` and ``cat``."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.cli.console import console, print_json, progress_bar
from ipsys_log.cli.options import AsJson, LogList, ReadLogs, log_argument
from ipsys_log.cli.signals import writes_nothing
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.log.dataset import Session
    from ipsys_log.log.location import LogLocation

Logs = Annotated[LogList, log_argument(help="Logs, files or URLs; each one is read separately.")]
_Seconds = float | None


def add_commands(app: typer.Typer) -> None:
    app.command()(check)
    app.command()(du)
    app.command()(cat)


@writes_nothing
def check(
    logs: Logs,
    details: Annotated[
        bool, typer.Option("--details", help="Also print notes: rates, unknown channels, current runs.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Read logs completely and check them: file, channels, times, rates, references and runs.

    The exit code is 0 if all logs are sound, 1 if they are readable with remarks, and 2 if one is broken.
    It is 3 if none is broken, but one could not be read, such as a URL without a connection. Runs may have
    their inputs in another of the given logs."""
    from ipsys_log.report.log_texts import check_json, check_lines
    from ipsys_log.soundness.check import check_logs
    from ipsys_log.soundness.finding import READABLE, SOUND, UNREAD, LogCheck

    with progress_bar(()) as progress:
        checks = check_logs(logs, progress)
    if as_json:
        print_json(check_json(checks))
    else:
        for one in checks:
            for line in check_lines(one, details):
                console.print(line)
    code = {SOUND: 0, READABLE: 1, UNREAD: 3}.get(LogCheck.worst(checks), 2)
    if code:
        raise typer.Exit(code)


@writes_nothing
def du(logs: Logs, as_json: AsJson = False) -> None:
    """Show the size of each channel of a log, the largest first.

    The payload is counted before compression. A compressed chunk counts in proportion to the bytes of its
    messages."""
    from ipsys_log.report.log_texts import sizes_table

    results = [_sizes(path) for path in logs]
    if as_json:
        print_json(results)
        return
    for number, result in enumerate(results):
        if number:
            console.print()
        console.print(sizes_table(result))


def _sizes(path: LogLocation) -> dict[str, Any]:
    from ipsys_log.log.reader import LogReader
    from ipsys_log.report.log_texts import sizes_json

    with LogReader(path) as reader, progress_bar(()) as progress:
        sizes = reader.sizes(lambda done: progress("chunks", done, reader.chunk_count))
        return sizes_json(str(path), reader.size, sizes)


@writes_nothing
def cat(
    logs: ReadLogs,
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", metavar="TOPIC,...", help="Print only these topics, separated by commas."),
    ] = None,
    start_secs: Annotated[
        _Seconds,
        typer.Option("--start-secs", metavar="SECONDS", help="Begin at this log time since 1970, in UTC."),
    ] = None,
    end_secs: Annotated[
        _Seconds,
        typer.Option("--end-secs", metavar="SECONDS", help="End before this log time since 1970, in UTC."),
    ] = None,
    start_offset: Annotated[
        _Seconds,
        typer.Option("--start-offset", metavar="SECONDS", help="Begin so long after the first message."),
    ] = None,
    end_offset: Annotated[
        _Seconds,
        typer.Option("--end-offset", metavar="SECONDS", help="End so long after the first message."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the messages of a log in log order, one line each: time (UTC), topic, schema and short content.

    With --json, each line is a JSON object with all values; images are given by their size."""
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.log_texts import message_json, message_line

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
    from ipsys_log.errors import IpsysError

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
    """Return the time in ns that lies `seconds` after `start_ns`; None without an option.

    Raises
    ------
    IpsysError
        The value is not a number of seconds of these centuries.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.units import NS_PER_S

    if seconds is None:
        return None
    if not 0 <= seconds < 1e10:
        raise IpsysError(f"{seconds:g} s is no time in a log; give seconds from 0 on")
    return start_ns + round(seconds * NS_PER_S)
