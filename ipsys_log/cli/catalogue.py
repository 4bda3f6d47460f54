"""The catalogue of a folder with logs: ``ipsys catalogue``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.cli.console import console, print_json, progress_bar
from ipsys_log.cli.options import AsJson

if TYPE_CHECKING:
    from ipsys_log.log.location import LogLocation

_MOST_LINES = 30


def add_commands(app: typer.Typer) -> None:
    app.command()(catalogue)


def catalogue(
    folder: Annotated[
        str,
        typer.Argument(
            metavar="FOLDER",
            help="The folder, or its URL; all logs below it are in the catalogue. A URL may have a pattern, "
            "such as s3://lab/2026-*/*.mcap.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="The catalogue: a Parquet file (.parquet)."),
    ],
    baseline: Annotated[
        str | None,
        typer.Option(
            "--baseline",
            metavar="LOG",
            help="Also record the drift of the cameras since this log, by their reference markers.",
        ),
    ] = None,
    model_from: Annotated[
        str | None,
        typer.Option(
            "--model-from", metavar="LOG", help="The log with the model for the drift. Default: the baseline."
        ),
    ] = None,
    derived: Annotated[
        Path | None,
        typer.Option(
            "--derived",
            metavar="FOLDER",
            help="The folder of -o in ipsys batch replay, with the results of logs that cannot be appended "
            "to. They count with their log. Default: the working folder.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a table with a row for each log: cameras, times, runs, versions, errors of models, gaps, drift.

    The command reads only logs that are new or have changed since the last call. A log that cannot be read
    has a row with its error, and the command still succeeds. pandas and DuckDB read the file.
    """
    from ipsys_log.catalogue.row import Baseline
    from ipsys_log.catalogue.table import update_catalogue
    from ipsys_log.errors import IpsysError
    from ipsys_log.extras import check_installed
    from ipsys_log.log.location import parse_location
    from ipsys_log.plain_text import plain_text
    from ipsys_log.report.files import check_file, check_parquet_name

    check_installed("catalogue needs", "pyarrow")
    check_parquet_name(output, "-o")
    check_file(output, "-o", [])
    if derived is not None and not derived.is_dir():
        raise IpsysError(f"--derived {derived}: is not a folder; name the folder of the derived logs")
    if model_from is not None and baseline is None:
        raise IpsysError("--model-from: has an effect only with --baseline; give the log before all moves")
    since = None
    if baseline is not None:
        log = _log("--baseline", baseline)
        since = Baseline(log, log if model_from is None else _log("--model-from", model_from))
    place = parse_location(folder)
    with progress_bar(()) as progress:
        update = update_catalogue(
            place, output, since, derived, lambda done, total: progress("logs", done, total)
        )
    if as_json:
        print_json(asdict(update))
        return
    removed = f", {update.removed} removed" if update.removed else ""
    console.print(f"{output} written: {update.logs} logs, {update.read} read{removed}")
    errors = [f"{log}: {text}" for log, text in update.errors.items()]
    for line in errors[:_MOST_LINES]:
        console.print(plain_text(line), style="yellow")
    if len(errors) > _MOST_LINES:
        console.print(f"and {len(errors) - _MOST_LINES} more logs with errors: --json lists all")


def _log(name: str, text: str) -> LogLocation:
    from ipsys_log.errors import IpsysError
    from ipsys_log.log.location import parse_location

    log = parse_location(text)
    if isinstance(log, Path) and not log.is_file():
        raise IpsysError(f"{name} {log}: is not a file; name a log")
    return log
