"""Look at a log in Rerun: ``ipsys view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from ipsys_log.cli.console import remarks, say
from ipsys_log.cli.options import Logs

__all__ = ["add_commands"]

Runs = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--run", metavar="NAME", help="A run to show, instead of the newest; repeat for several."),
]
Save = Annotated[
    Path | None,
    typer.Option("--save", metavar="FILE", help="Write a Rerun recording (.rrd); needs no screen."),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(view)


def view(logs: Logs, run: Runs = None, save: Save = None) -> None:
    """Show frames with drawn markers, floor, measured places, positions and tracks over time, in Rerun."""
    from ipsys_log.log.dataset import Session

    if save is not None:
        _check_save(save, logs)
    from ipsys_log.runs.states import out_of_date_lines
    from ipsys_log.sinks.rerun.recording import write_recording

    with Session(logs) as session:
        shown = write_recording(session, run or (), save)
        for line in out_of_date_lines(session, [shown.markers, *shown.runs]):
            say(line)
    for what, names in (("markers", [shown.markers]), ("positions and tracks", shown.runs)):
        named = ", ".join(name for name in names if name)
        if named:
            remarks.print(f"{what:<21} run {named}")
    if save is not None:
        remarks.print(f"{save} written; look at it with: rerun {save}")


def _check_save(save: Path, logs: list[Path]) -> None:
    """Check that a recording can be written, and that Rerun will open it by its name."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.report.files import check_file

    if save.suffix != ".rrd":
        raise IpsysError(f"--save {save}: Rerun opens recordings that end in .rrd; name it {save.stem}.rrd")
    check_file(save, "--save", logs)
