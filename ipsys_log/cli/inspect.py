"""Look at a log: ``ipsys info``, ``ipsys runs``, ``ipsys view``, ``ipsys repair``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import console, print_outcomes, progress_bar, remarks
from ipsys_log.cli.options import AsJson, Logs

__all__ = ["add_commands"]


def add_commands(app: typer.Typer) -> None:
    app.command()(info)
    app.command()(runs)
    app.command()(repair)


def info(logs: Logs, as_json: AsJson = False) -> None:
    """Show cameras, channels, counts, rates, gaps and runs of a log."""
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.contents import contents_json, contents_tables

    with Session(logs) as session:
        found = contents_json(session)
    if as_json:
        print(json.dumps(found, indent=2))  # noqa: T201
    else:
        for number, table in enumerate(contents_tables(found)):
            if number:
                console.print()
            console.print(table)


def runs(logs: Logs, as_json: AsJson = False) -> None:
    """Show the runs of a log: stage, inputs, parameters, version of ipsys, and whether it is up to date.

    The state is: current; out of date, with the reason (replay computes it again as a new run); not
    repeatable (its inputs are not in the log); unfinished (its writer was stopped).
    """
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.contents import runs_table, states_json

    with Session(logs) as session:
        found = states_json(session)
    if as_json:
        print(json.dumps(found, indent=2))  # noqa: T201
    else:
        console.print(runs_table(found))


def repair(
    log: Annotated[Path, typer.Argument(help="A log whose writer was killed, or that was cut off.")],
) -> None:
    """Repair a log in place: keep all whole records, report what is gone, and finish its runs.

    All bytes that are taken out are kept in <log>.damaged. A log that cannot be repaired is not changed. If
    ipsys live or record --detect was killed, its recorded frames without results are processed now. This
    repeats the runs to check them; Ctrl-C leaves it to ipsys replay.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.log.dataset import Session
    from ipsys_log.log.repair import repair as repair_log
    from ipsys_log.report.repair import repair_lines

    for part in repair_lines(repair_log(log)):
        console.print(part, markup=False)
    try:
        with Session([log]) as session:
            if not session.run_names():
                return  # nothing to finish, and no stage to import for it
        from ipsys_log.restore import finish_runs

        with progress_bar() as progress:
            print_outcomes(finish_runs(log, progress))
    except IpsysError as error:  # the log itself is whole
        remarks.print(f"its runs cannot be finished: {error}", style="yellow", markup=False)
