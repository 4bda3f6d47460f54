"""A session as one page to read and to pass on: ``ipsys report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from ipsys_log.cli.console import console
from ipsys_log.cli.stages import EVALUATE, MORE, build_command, derived, options_of

__all__ = ["add_commands"]

_HTML = (
    Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--html", metavar="FILE", help="The page, instead of the log's name with .html."),
    ],
    None,
)
_HELP = f"Write one HTML page that says how good the models of a log are; it needs no network.{MORE}"


def add_commands(app: typer.Typer) -> None:
    names = [name for name in EVALUATE if name not in ("as_json", "plots")]
    app.command("report", help=_HELP)(build_command({**options_of(names), "html": _HTML}, _report))


def _report(logs: list[Path], output: Path | None, html: Path | None, **given: Any) -> None:
    from ipsys_log.report.files import check_file, write_files
    from ipsys_log.report.html import render_report

    target = html or (output or logs[-1]).with_suffix(".html")
    check_file(target, "--html", [*logs, *([output] if output else [])])
    with derived(logs, "evaluate", output, **given) as (session, _, accuracies):
        write_files(target.parent, {target.name: render_report(session, accuracies).encode()})
    console.print(f"{target} written: open it in a browser", markup=False)
