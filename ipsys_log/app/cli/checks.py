"""Checks of a log, and its repair: ``ipsys check``, ``ipsys verify`` and ``ipsys repair``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from ipsys_log.app.cli.console import console, print_outcomes, print_result, progress_bar, say, warn
from ipsys_log.app.cli.options import AsJson, LogList, appended_log_argument, log_argument, named, switch
from ipsys_log.app.cli.signals import writes_nothing
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation

if TYPE_CHECKING:
    from ipsys_log.tools.differences import Comparison

Logs = Annotated[LogList, log_argument(help="Logs, files or URLs; each one is read separately.")]


@writes_nothing
def check(
    logs: Logs,
    details: Annotated[
        bool, switch("--details", "Also print notes: rates, unknown channels, current runs.")
    ] = False,
    as_json: AsJson = False,
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
        LogList,
        log_argument(help="Logs, files or URLs, read as one session. With --compare: one or two logs."),
    ],
    run: Annotated[
        list[str] | None,
        named("--run", "NAME", "Use only this run. With --compare, give it twice for two runs."),
    ] = None,
    compare: Annotated[
        bool,
        switch("--compare", "Compare the runs of two logs, or two runs of one log, and compute nothing."),
    ] = False,
    as_json: AsJson = False,
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
