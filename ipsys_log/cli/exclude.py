"""Exclusion of calibration points: ``ipsys exclude``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.options import AsJson, appended_log_argument
from ipsys_log.plain_text import shell_words


def add_commands(app: typer.Typer) -> None:
    app.command()(exclude)


def exclude(
    log: Annotated[
        Path,
        appended_log_argument(help="A finished log with measurements, which gets the change."),
    ],
    points: Annotated[
        list[str],
        typer.Argument(metavar="POINT", help="Names of calibration points, such as p007."),
    ],
    reason: Annotated[str, typer.Option(metavar="TEXT", help="The reason, which is written into the log.")],
    readmit: Annotated[
        bool, typer.Option("--readmit", help="Use excluded points again, instead of excluding points.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Exclude calibration points of a log from all stages, or re-admit them. Nothing is erased.

    The command appends a message for each point. Models of the log are then out of date, and ipsys replay
    fits them again. A point that is excluded already causes no change.
    """
    from ipsys_log.survey import exclusion

    result = (exclusion.readmit if readmit else exclusion.exclude)(log, points, reason)
    done, before = ("re-admitted", "not excluded") if readmit else ("excluded", "excluded already")
    for name, text in result.unchanged.items():
        remarks.print(f"{name} is {before}{f': {text}' if text else ''}", style="yellow", markup=False)
    if as_json:
        key = "readmitted" if readmit else "excluded"
        rows = {"log": str(log), key: result.changed, "unchanged": [*result.unchanged]}
        print(json.dumps({**rows, "active": result.active}))  # noqa: T201
        return
    if not result.changed:
        console.print(f"{log} is unchanged", markup=False)
        return
    console.print(
        f"{done}: {', '.join(result.changed)}; calibration points in use: {result.active}", markup=False
    )
    remarks.print(f"next: ipsys replay {shell_words(log)}", markup=False)
