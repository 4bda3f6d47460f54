"""Export of positions and other channels: ``ipsys export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from ipsys_log.cli.console import console
from ipsys_log.cli.options import ReadLogs

__all__ = ["add_commands"]


def add_commands(app: typer.Typer) -> None:
    app.command()(export)


def export(
    logs: ReadLogs,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="The file to write: .csv or .parquet for a table, .tum or .kitti for a trajectory.",
        ),
    ],
    table: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="tracks, positions, markers, camera_points, measurements, events, latency or truth.",
        ),
    ] = "tracks",
    run: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--run", metavar="NAME", help="Export this run instead of the newest; repeat it for several."
        ),
    ] = None,
    robot: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="NAME", help="Export only this robot."),
    ] = None,
) -> None:
    """Export positions or another channel to a file for other programs: one row for each robot and instant.

    Units are in the names of the columns. Times are in UTC."""
    from ipsys_log import api
    from ipsys_log.report.files import check_file

    check_file(output, "-o", logs)
    with api.open(*logs) as log:
        exported = log.export(output, table, run, robot)
    console.print(
        f"{output} written: {exported.rows} rows of {table}"
        + (f", run {' and '.join(exported.runs)}" if exported.runs else "")
    )
