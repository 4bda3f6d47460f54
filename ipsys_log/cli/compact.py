"""Copy of a log without superseded runs: ``ipsys compact``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from ipsys_log.cli.console import console, progress_bar
from ipsys_log.cli.options import AsJson, OneLog, Overwrite, log_option, one_log_argument

if TYPE_CHECKING:
    from ipsys_log.log.location import LogLocation
    from ipsys_log.runs.compact import DroppedRun


def add_commands(app: typer.Typer) -> None:
    app.command()(compact)


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
        _show(log, size, dropped)
    if output is not None and is_written:
        with progress_bar() as progress:
            compaction.compact(log, output, overwrite, progress)
    if as_json:
        print(json.dumps(_as_json(log, size, output if is_written else None, dropped), indent=2))  # noqa: T201
    elif output is not None and is_written:
        _show_result(size, output)


def _show(log: LogLocation, size: int, dropped: list[DroppedRun]) -> None:
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


def _show_result(before: int, output: Path) -> None:
    from ipsys_log.units import format_bytes

    after = output.stat().st_size
    console.print(f"{output} written: {format_bytes(after)} instead of {format_bytes(before)}", markup=False)


def _as_json(log: LogLocation, size: int, output: Path | None, dropped: list[DroppedRun]) -> dict[str, Any]:
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
