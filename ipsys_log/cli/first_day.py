"""The first day in a browser: ``ipsys setup``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.measure_live import say_faults
from ipsys_log.cli.options import Host, Port
from ipsys_log.cli.signals import allow_interrupt, runs_until_stopped, stop_on_signal

_PORT = 8000

Folder = Annotated[
    Path,
    typer.Argument(metavar="FOLDER", help="The folder of the lab: it gets lab.toml, intrinsics and logs."),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(setup)


@runs_until_stopped
def setup(folder: Folder, host: Host = None, port: Port = _PORT) -> None:
    """Set a lab up on a page, step by step: rig, cameras, intrinsics, points, fit, and the live view.

    Each step does what its command does, and names it. The state comes from the files of FOLDER: you can
    leave at any time, continue later, and use the commands in between. Ctrl-C ends the page."""
    allow_interrupt("stopped; every finished step is in the folder")
    from ipsys_log.errors import IpsysError
    from ipsys_log.extras import check_installed
    from ipsys_log.report.files import check_folder

    check_installed("setup needs", "starlette", "uvicorn")
    check_folder(folder, "FOLDER")
    from ipsys_log.first_day.lab_folder import LabFolder
    from ipsys_log.web.first_day.app import SetupApp
    from ipsys_log.web.server import check_port_free, qr_code, serve_app

    check_port_free(host, port)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IpsysError(f"{folder}: cannot be made: {error.strerror}") from error
    page = SetupApp(LabFolder(folder))
    signals: list[None] = []  # a list: an Event takes a lock that the interrupted thread may hold
    with serve_app(page.app, host, port, has_viewers=True) as server:
        stop_on_signal(lambda: signals.append(None))
        if host is not None:
            console.print(qr_code(server.url), style="#ffffff on #000000", markup=False)
        console.print(f"open {server.url}", markup=False)
        if server.view_url is not None:
            remarks.print(f"to view only: {server.view_url}", markup=False)
        remarks.print(f"Ctrl-C ends; to continue: {_command(folder, host, port)}", markup=False)
        try:
            server.wait(lambda: bool(signals))
        finally:
            page.session.close()
            say_faults(server, "the setup page")
            for bug in page.session.jobs.bugs:
                remarks.print(bug, markup=False, highlight=False)
    if page.session.jobs.bugs:
        raise typer.Exit(1)


def _command(folder: Path, host: str | None, port: int) -> str:
    """Return the command that continues with the same options."""
    options = [] if host is None else ["--host", host]
    options += [] if port == _PORT else ["--port", str(port)]
    return shlex.join(["ipsys", "setup", str(folder), *options])
