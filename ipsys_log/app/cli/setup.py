"""Setup of a lab: ``ipsys setup`` on a page, ``ipsys init``, ``ipsys cameras`` and ``ipsys markers``."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.app.cli.console import console, print_result, say
from ipsys_log.app.cli.options import AsJson, Host, OtherLog, Port, other_log_option, setting, switch
from ipsys_log.app.cli.pages import print_code, say_faults
from ipsys_log.app.cli.signals import allow_interrupt, runs_until_stopped, stop_on_signal, writes_nothing
from ipsys_log.app.report.files import check_file, check_folder, write_files
from ipsys_log.app.report.rows import counted
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogLocation
from ipsys_log.plain_text import HIDDEN, shell_words

if TYPE_CHECKING:
    from ipsys_log.app.report.prints import Print
    from ipsys_log.capture.usb_bus import UsbCamera
    from ipsys_log.messages import Rig

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
    from ipsys_log.engine.request import rig_with_offsets
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
    from ipsys_log.app.web.server import check_port_free, serve_app
    from ipsys_log.app.web.setup import SetupApp

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
        Path | None, setting("--rig", "FILE", "Check that USB is fast enough for the cameras of this rig.")
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


RigNow = Annotated[
    Path | None, setting("--rig", "FILE", "Print the markers of this rig file, in their true size.")
]
Ids = Annotated[
    str | None,
    setting("--ids", "LIST", "Print these ids, such as 1,2,3 or 0-9, instead of the ids of the rig."),
]
Length = Annotated[
    float | None,
    setting("--length", "METRES", "Side of the black square, in m, instead of the lengths of the rig."),
]
Dictionary = Annotated[
    str | None,
    setting(
        "--dictionary",
        "NAME",
        "Dictionary of --ids without a rig (default: DICT_4X4_100) and of a ChArUco board "
        "(default: DICT_4X4_50).",
    ),
]
BoardName = Annotated[
    str | None,
    setting(
        "--board",
        "COLUMNSxROWS",
        "Print a board for ipsys calibrate: inner corners of a chessboard, such as 6x4, or "
        "squares of a ChArUco board, such as charuco:4x5.",
    ),
]
Square = Annotated[float, setting("--square", "METRES", "Side of a square of the board, in m.")]
MarkerScale = Annotated[
    float,
    setting("--marker-scale", "SHARE", "Side of a ChArUco marker, as a fraction of the side of a square."),
]
PageName = Annotated[
    str | None, setting("--page", "NAME", "Paper: a4, letter or a3. Default: a4, or a3 if a4 is too small.")
]
Output = Annotated[Path, setting("--output,-o", "FILE", "The PDF to write.")]
Force = Annotated[bool, switch("--force", "Overwrite an existing file.")]

_DICTIONARY, _BOARD_DICTIONARY = "DICT_4X4_100", "DICT_4X4_50"
_MOST = 2000


def markers(
    rig: RigNow = None,
    ids: Ids = None,
    length: Length = None,
    dictionary: Dictionary = None,
    board: BoardName = None,
    square: Square = 0.03,
    marker_scale: MarkerScale = 0.75,
    page: PageName = None,
    output: Output = Path("markers.pdf"),
    force: Force = False,
) -> None:
    """Draw markers and calibration boards as a PDF at true size, with a ruler to check the print.

    Each marker has its white margin, cutting marks, its id and an arrow to its front: the direction of its
    heading. Print at 100 % ("actual size"), and measure the ruler: it is 10 cm long.

    Examples

        ipsys markers --rig lab.toml                # all markers of the rig
        ipsys markers --ids 0-11 --length 0.08 --page letter
        ipsys markers --board 6x4 -o board.pdf      # for ipsys calibrate
    """
    check_installed("markers needs", "matplotlib")
    from ipsys_log.app.report.prints import board_print, choose_paper, draw_pages, lay_out
    from ipsys_log.messages.rig_file import load_rig

    if output.suffix.lower() != ".pdf":
        raise IpsysError(f"--output {output}: only a PDF keeps the true size; use a name that ends in .pdf")
    check_file(output, "--output", [])
    if output.exists() and not force:
        raise IpsysError(f"{output}: exists already; give another name, or --force to overwrite it")
    prints = _marker_prints(rig, ids, length, dictionary) if rig or ids else []
    if board is not None:
        from ipsys_log.calibration.board import parse_board

        drawn = parse_board(board, square, marker_scale, dictionary or _BOARD_DICTIONARY, False)
        prints.append(board_print(drawn, board))
    if not prints:
        raise IpsysError("nothing to print: give --rig lab.toml, --ids 0-9 --length 0.1, or --board 6x4")
    paper = choose_paper(prints, page)
    pages = lay_out(prints, paper)
    write_files(output.parent, {output.name: draw_pages(pages)})
    console.print(f"{output} written: {counted(len(pages), 'page')} of {paper.name}, {_contents(prints)}")
    if rig is not None and ids is None and load_rig(rig).is_simulated:
        console.print("these are its robots' markers, to try a print: the simulated lab needs none")
    elif page is None and paper.name != "A4":
        console.print("A4 is too small. Print on A3, or use --length 0.14 for markers that fit on A4")
    console.print('print at 100 % ("actual size"), and check that the printed ruler is 10 cm long')


def _marker_prints(
    rig: Path | None, ids: str | None, length: float | None, dictionary: str | None
) -> list[Print]:
    from ipsys_log.app.report.prints import rig_prints

    lab = _lab(rig, length, dictionary)
    wanted = None if ids is None else _parse_ids(ids, lab.dictionary)
    if wanted is None and not (lab.markers or lab.reference_markers):
        raise IpsysError(f"{rig}: has no [[markers]]; give ids, such as --ids 0-9")
    return rig_prints(lab, wanted, length)


def _lab(rig: Path | None, length: float | None, dictionary: str | None) -> Rig:
    """Return the rig, or a rig with only a dictionary and a length."""
    from dataclasses import replace

    from ipsys_log.messages import Rig
    from ipsys_log.messages.rig_checks import check_units
    from ipsys_log.messages.rig_file import check_rig, load_rig
    from ipsys_log.stages.detect.search import marker_detector

    if rig is not None:
        lab = load_rig(rig)
    elif length is None:
        raise IpsysError(
            "--ids: the side of the markers is missing; add --length 0.1 (in m), or --rig lab.toml"
        )
    else:
        lab = Rig("lab", (dictionary or _DICTIONARY).upper(), length)
    marker_detector(lab.dictionary)
    if length is not None:
        lab = replace(lab, marker_length_m=length)
        check_units(check_rig(lab, "--length"), "--length")
    return lab


def _parse_ids(text: str, dictionary: str) -> list[int]:
    """Parse a list of ids of a dictionary, such as ``1,2,5-9``; each id occurs once."""
    from ipsys_log.messages.rig_checks import dictionary_size

    ids: list[int] = []
    for part in text.split(","):
        first, dash, last = (text.strip() for text in part.partition("-"))
        if not first.isdecimal() or (dash and not last.isdecimal()) or len(part) > 12:
            raise IpsysError(f"--ids {text}: is not a list of ids; write 1,2,3 or 0-9")
        ids += range(int(first), min(int(last or first), int(first) + _MOST) + 1)
    size = dictionary_size(dictionary)
    if not ids or (size is not None and max(ids) >= size):
        raise IpsysError(
            f"--ids {text}: {dictionary} has the ids 0 to {(size or 1) - 1}; give ids in this range"
        )
    return list(dict.fromkeys(ids))


def _contents(prints: list[Print]) -> str:
    count = sum(not item.is_board for item in prints)
    parts = [counted(count, "marker")] if count else []
    return " and ".join([*parts, *(item.name for item in prints if item.is_board)])
