"""Tape measurements into a log: ``ipsys measure``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.cli.console import console, progress_bar, remarks
from ipsys_log.cli.options import AsJson, Calibrations, RigFile, cameras_of, load_calibrations

if TYPE_CHECKING:
    from ipsys_log.finished import FinishedLog
    from ipsys_log.measuring.scene import Scene
    from ipsys_log.messages import Measurement

__all__ = ["add_commands", "serve_page"]

Log = Annotated[Path, typer.Argument(metavar="LOG", help="A finished log; the measurements go into it.")]
Terminal = Annotated[bool, typer.Option("--terminal", help="Ask here in the terminal instead of on a page.")]
Sheet = Annotated[
    Path | None,
    typer.Option("--csv", metavar="SHEET", help="Read a sheet (docs/measuring.md has its header) instead."),
]
Places = Annotated[
    bool, typer.Option("--places", help="Only list where markers lie still, as a sheet numbers them.")
]
Host = Annotated[
    str | None,
    typer.Option(
        "--host",
        metavar="ADDRESS",
        help="Let a phone in this network open the page, at 0.0.0.0 (all addresses of this machine) or at "
        "one of them. It is shown with a secret that is new at each start. Without it: this machine alone.",
    ),
]
Port = Annotated[
    int,
    typer.Option(min=0, max=65535, metavar="PORT", help="The port of the page; 0 takes any that is free."),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(measure)


def measure(
    log: Log,
    terminal: Terminal = False,
    csv: Sheet = None,
    places: Places = False,
    host: Host = None,
    port: Port = 8000,
    rig: RigFile = None,
    calibration: Calibrations = None,
    as_json: AsJson = False,
) -> None:
    """Enter tape measurements: on a page for the phone, in the terminal, or from a sheet.

    Goes through the places where a marker lies still, checks what is typed at once, and appends it. Undo
    withdraws a measurement; nothing is erased.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.finished import add_sheet, opened_log
    from ipsys_log.request import Request
    from ipsys_log.rig import load_rig

    if sum((terminal, csv is not None, places)) > 1:
        raise IpsysError("--terminal, --csv and --places exclude one another; give one of them")
    lenses = load_calibrations(calibration, lambda: cameras_of([log]))
    request = Request(rig=load_rig(rig) if rig else None, lenses=lenses)
    with ExitStack() as stack:
        with progress_bar() as progress:
            scene = stack.enter_context(opened_log(log, request, progress))
        if places:
            _show_places(scene, as_json)
            return
        before = len(scene.history())
        if csv is not None:
            for text in add_sheet(scene, csv):
                remarks.print(text, style="yellow", markup=False)
        elif terminal:
            from ipsys_log.cli.dialog import ask_places

            ask_places(scene)
        else:
            serve_page(scene, host, port)
        _show_count(log, scene.history()[before:], as_json)
    if rig is not None:
        remarks.print(
            f"give --rig {rig} to ipsys replay, too: it measured with these reference points", markup=False
        )


def serve_page(scene: Scene, host: str | None, port: int) -> None:
    """Serve the page until it is interrupted."""
    from ipsys_log.web.serving import qr_code, serving

    with serving(scene, host, port) as page:
        if host is not None:
            console.print(qr_code(page.url), style="#ffffff on #000000", markup=False)
        console.print(f"open {page.url}", markup=False)
        remarks.print("Ctrl-C ends it; every place is in the log as soon as it is saved")
        try:
            page.wait()
        except KeyboardInterrupt:
            remarks.print()


def _show_count(log: Path, added: Sequence[Measurement], as_json: bool) -> None:
    withdrawn = sum(measurement.withdraws is not None for measurement in added)
    count = len(added) - withdrawn
    if as_json:
        print(json.dumps({"log": str(log), "measured": count, "withdrawn": withdrawn}))  # noqa: T201
        return
    also = f", {withdrawn} withdrawn" if withdrawn else ""
    console.print(f"{count} place{'' if count == 1 else 's'} measured into {log}{also}", markup=False)


def _show_places(scene: FinishedLog, as_json: bool) -> None:
    from ipsys_log.report.stops import stops_json, stops_table

    found = stops_json(scene)
    if as_json:
        print(json.dumps(found, indent=2))  # noqa: T201
    else:
        console.print(stops_table(found))
