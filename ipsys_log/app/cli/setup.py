"""Setup of a lab: ``ipsys setup`` on a page, ``ipsys init`` and ``ipsys cameras``."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.app.cli.console import console, print_result, say
from ipsys_log.app.cli.options import AsJson, Host, OtherLog, Port, named, other_log_option, switch
from ipsys_log.app.cli.pages import print_code, say_faults
from ipsys_log.app.cli.signals import allow_interrupt, runs_until_stopped, stop_on_signal, writes_nothing
from ipsys_log.app.report.files import check_folder
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogLocation
from ipsys_log.plain_text import HIDDEN, shell_words

if TYPE_CHECKING:
    from ipsys_log.capture.usb_bus import UsbCamera

_NONE = """no USB camera is attached
  for a network camera, put its address into lab.toml: source = "rtsp://..." or "http://..."
  without a camera, source = "sim:red" is a simulated one: ipsys init lab.toml --simulated"""
_PORT = 8000

_Folder = Annotated[
    Path,
    typer.Argument(metavar="FOLDER", help="The folder of the lab: it gets lab.toml, intrinsics and logs."),
]


def init(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="The rig file to write.")] = Path("lab.toml"),
    log: Annotated[
        OtherLog,
        other_log_option("--from", help="Write the rig of a log, a file or a URL, with its camera settings."),
    ] = None,
    simulated: Annotated[
        bool,
        switch(
            "--simulated",
            "Write the rig of the simulated lab, to try all commands without a camera, and a sheet of "
            "its tape measurements.",
        ),
    ] = False,
) -> None:
    """Write a rig file to edit: markers, cameras, reference points, floor. With comments, or from a log.

    Examples

        ipsys init lab.toml                      # an example with comments
        ipsys init lab.toml --from monday.mcap   # the rig of a log
        ipsys init lab.toml --simulated          # to try all commands
    """
    from ipsys_log.exchange.lab_files import write_new
    from ipsys_log.messages.rig_file import example_toml

    if simulated:
        if log is not None:
            raise IpsysError("--from and --simulated cannot be used together; give one of them")
        _init_simulated(path)
        return
    text = example_toml() if log is None else _rig_of(log)
    write_new({path: text})
    console.print(f"{path} written: edit it to describe your lab")
    if HIDDEN in text:
        console.print(f"a log has no passwords: in each source, replace {HIDDEN} by its password")


def _init_simulated(path: Path) -> None:
    from ipsys_log.exchange.lab_files import simulated_lab_texts, tape_sheet_path, write_new

    texts = simulated_lab_texts(path)
    write_new(texts)
    tape = tape_sheet_path(path)
    lines = texts[tape].splitlines()
    console.print(f"{path} written: the simulated lab, with three cameras")
    console.print(f"{tape} written: the tape measurements of its {len(lines) - 1} stationary markers")
    console.print(f"next: ipsys align --rig {shell_words(path)}")


def _rig_of(log: LogLocation) -> str:
    from ipsys_log.engine.select import rig_with_offsets
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.rig_file import rig_toml

    with Session([log]) as session:
        # A log opens no socket: its streams are left out.
        return rig_toml(replace(rig_with_offsets(session), stream=None))


@runs_until_stopped
def setup(folder: _Folder, host: Host = None, port: Port = _PORT) -> None:
    """Set a lab up on a page, step by step: rig, cameras, intrinsics, points, fit, and the live view.

    Each step does what its command does, and names it. The state comes from the files of FOLDER: you can
    leave at any time, continue later, and use the commands in between. Ctrl-C ends the page.

    Examples

        ipsys setup lab                          # all steps of the first day
        ipsys setup lab --host 0.0.0.0           # also on a tablet
    """
    allow_interrupt("stopped; every finished step is in the folder")
    check_installed("setup needs", "starlette", "uvicorn")
    check_folder(folder, "FOLDER")
    from ipsys_log.app.first_day.lab_folder import LabFolder
    from ipsys_log.app.web.first_day.app import SetupApp
    from ipsys_log.app.web.server import check_port_free, serve_app

    check_port_free(host, port)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IpsysError(f"{folder}: cannot be made: {error.strerror}") from error
    page = SetupApp(LabFolder(folder))
    signals: list[None] = []  # a list: an Event takes a lock that the interrupted thread may hold
    with serve_app(page.app, host, port, has_viewers=True) as server:
        stop_on_signal(lambda: signals.append(None))
        print_code(server.url, host is not None)
        console.print(f"open {server.url}")
        if server.view_url is not None:
            say(f"to view only: {server.view_url}")
        say(f"Ctrl-C ends; to continue: {_command(folder, host, port)}")
        try:
            server.wait(lambda: bool(signals))
        finally:
            page.session.close()
            say_faults(server, "the setup page")
            for bug in page.session.jobs.bugs:
                say(bug)
    if page.session.jobs.bugs:
        raise typer.Exit(1)


@writes_nothing
def cameras(
    rig: Annotated[
        Path | None, named("--rig", "FILE", "Check that USB is fast enough for the cameras of this rig.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the USB cameras with device, modes, bus and hub, and check that USB is fast enough for all.

    Without --rig, the check uses the largest mode of each camera. Network cameras are not listed.

    Examples

        ipsys cameras                    # the source of each camera
        ipsys cameras --rig lab.toml     # is USB fast enough for the rig?
    """
    from ipsys_log.capture.usb_bus import advise_bandwidth, list_demands
    from ipsys_log.messages.rig_file import load_rig

    if sys.platform != "linux":
        raise IpsysError(
            "ipsys cameras: lists cameras only on Linux; on this system, write usb:0, usb:1 and so on"
        )
    from ipsys_log.capture.usb_bus import find_cameras

    attached = find_cameras()
    advice = advise_bandwidth(list_demands(attached, load_rig(rig) if rig else None))
    lines = [_describe(camera) for camera in attached] or [_NONE]
    result = {"cameras": [_plain(camera) for camera in attached], "advice": advice}
    print_result(result, (*lines, *advice), as_json)


def _plain(camera: UsbCamera) -> dict[str, Any]:
    plug = camera.plug._asdict() if camera.plug else None
    return camera._asdict() | {"plug": plug, "modes": [mode._asdict() for mode in camera.modes]}


def _describe(camera: UsbCamera) -> str:
    lines = [f'{camera.name}: source = "usb:{camera.stable or camera.device}"']
    if camera.stable:
        lines.append(f"  {camera.device}")
    if camera.plug:
        bus, port, speed_mbit_s, hub, _ = camera.plug
        lines.append(f"  USB bus {bus}, port {port}, {speed_mbit_s:g} Mbit/s; hub: {hub}")
    rates: dict[tuple[str, int, int], list[float]] = {}
    for mode in camera.modes:
        rates.setdefault(mode[:3], []).append(mode.rate_hz)
    for (name, width, height), each in rates.items():
        text = ", ".join(f"{rate:.3g}" for rate in sorted(set(each), reverse=True))
        lines.append(f"  {name:<5}{width:>5} x {height:<5}{text} frames/s")
    if camera.fault:
        lines.append(f"  its modes cannot be read: {camera.fault}")
    return "\n".join(lines)


def _command(folder: Path, host: str | None, port: int) -> str:
    """Return the command that continues with the same options."""
    options = [] if host is None else ["--host", host]
    options += [] if port == _PORT else ["--port", str(port)]
    return shlex.join(["ipsys", "setup", str(folder), *options])
