"""Tape measurements of a log, and their exclusion: ``ipsys measure`` and ``ipsys exclude``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from ipsys_log.cli.console import console, progress_bar, remarks, say
from ipsys_log.cli.options import (
    AsJson,
    Calibrations,
    Corners,
    Host,
    ModelOfOther,
    Only,
    Port,
    RigFile,
    appended_log_argument,
    cameras_of,
    load_calibrations,
    load_matching_rig,
    log_option,
)
from ipsys_log.cli.signals import allow_interrupt, runs_until_stopped, stop_on_signal
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.messages import Measurement
    from ipsys_log.survey.from_log import FinishedLog
    from ipsys_log.survey.scene import MeasuringScene

Log = Annotated[
    Optional[Path],  # noqa: UP045
    appended_log_argument(
        help="A finished log, which gets the measurements. Without LOG: use the cameras of --rig now.",
    ),
]
Output = Annotated[
    Optional[Path],  # noqa: UP045
    log_option(help="Without LOG: the log to write, with about 1 s of frames of each point."),
]
Terminal = Annotated[bool, typer.Option("--terminal", help="Ask in the terminal instead of on a page.")]
Sheet = Annotated[
    Path | None,
    typer.Option(
        "--csv",
        metavar="SHEET",
        help="Read the measurements from a sheet; docs/measuring.md shows the columns.",
    ),
]
Insist = Annotated[
    bool,
    typer.Option(
        "--force",
        help="With --csv: write rows that look wrong, too. With cameras: overwrite an existing log of -o.",
    ),
]
Places = Annotated[
    bool,
    typer.Option(
        "--places", help="Only list the stationary intervals of the markers, with their numbers for a sheet."
    ),
]

Baseline = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        "--ab",
        metavar="CM",
        help="With LOG: the distance between the first two reference points, read with this tape, in cm. It "
        "shows the scale of the tape if the rig has ab_sigma_m.",
    ),
]

# The model that a replay fits, and the number of calibration points that gives good results.
_MODEL, _GOOD = "poly", 40


def add_commands(app: typer.Typer) -> None:
    app.command()(measure)
    app.command()(exclude)


@runs_until_stopped
def measure(
    log: Log = None,
    output: Output = None,
    terminal: Terminal = False,
    csv: Sheet = None,
    places: Places = False,
    ab: Baseline = None,
    host: Host = None,
    port: Port = 8000,
    rig: RigFile = None,
    camera: Only = None,
    calibration: Calibrations = None,
    corners: Corners = None,
    model_from: ModelOfOther = None,
    force: Insist = False,
    as_json: AsJson = False,
) -> None:
    """Enter tape measurements: on a page for the phone, in the terminal, or from a sheet.

    With --rig lab.toml -o places.mcap, the command uses the live cameras until Ctrl-C. It writes about a
    second of frames for each measured point. With a finished LOG, the command goes through the stationary
    intervals of the markers, and appends the measurements.

    The command checks each entry at once. Undo withdraws a measurement and erases nothing.
    """
    ends = csv is not None or places or ab is not None
    allow_interrupt(None if ends else "stopped; every saved point is in the log")
    from ipsys_log.errors import IpsysError
    from ipsys_log.extras import check_installed

    if sum((terminal, csv is not None, places, ab is not None)) > 1:
        raise IpsysError("--terminal, --csv, --places and --ab cannot be used together; give one of them")
    if not (terminal or ends):
        check_installed("the measuring page needs", "starlette", "uvicorn")
    if log is not None:
        _refuse(
            "live cameras; leave out LOG or this option",
            output=output,
            camera=camera,
            model_from=model_from,
        )
        if csv is None:
            _refuse("--csv or live cameras; leave it out", force=force)
        _measure_log(log, terminal, csv, force, places, ab, host, port, rig, calibration, corners, as_json)
        return
    _refuse("a finished log; name the log", csv=csv, places=places, ab=ab)
    if rig is None or output is None:
        raise IpsysError(
            "no log is given; name a finished log, or give --rig lab.toml -o places.mcap to use cameras"
        )
    from ipsys_log.cli.measure_live import measure_now

    measured = measure_now(output, rig, camera, calibration, corners, model_from, force, terminal, host, port)
    _show_count(output, measured, as_json)
    _show_next(output, measured)


def _refuse(where: str, **options: object) -> None:
    """Refuse options that belong to another way of measuring."""
    from ipsys_log.errors import IpsysError

    for name, value in options.items():
        if value:
            raise IpsysError(f"--{name.replace('_', '-')} is only for {where}")


def _measure_log(
    log: Path,
    terminal: bool,
    csv: Path | None,
    force: bool,
    places: bool,
    ab: str | None,
    host: str | None,
    port: int,
    rig: Path | None,
    calibration: list[str] | None,
    corners: str | None,
    as_json: bool,
) -> None:
    from ipsys_log.runs.options import Request
    from ipsys_log.survey.add_sheet import add_sheet, check_sheet
    from ipsys_log.survey.from_log import open_finished_log

    lenses = load_calibrations(calibration, lambda: cameras_of([log]))
    lab = load_matching_rig(rig, lambda: cameras_of([log]))
    request = Request(rig=lab, lenses=lenses, corners=corners)
    if csv is not None:
        check_sheet(csv, log, request)
    with ExitStack() as stack:
        with progress_bar() as progress:
            scene = stack.enter_context(open_finished_log(log, request, progress, say))
        if places:
            _show_places(scene, as_json)
            return
        before = len(scene.history())
        if ab is not None:
            from ipsys_log.survey.checks import read_baseline

            scene.add([read_baseline(ab, scene.rig, scene.history(), scene.start_ns)])
        elif csv is not None:
            for text in add_sheet(scene, csv, force):
                remarks.print(text, style="yellow", markup=False)
        elif terminal:
            from ipsys_log.cli.dialog import ask_places

            ask_places(scene)
        else:
            serve_page(scene, host, port)
        _show_count(log, scene.history()[before:], as_json)
        _show_next(log, scene.history())
    if rig is not None:
        remarks.print(
            f"give --rig {rig} to ipsys replay, too: the measurements use its reference points", markup=False
        )


def serve_page(scene: MeasuringScene, host: str | None, port: int) -> None:
    """Serve the page until an interrupt."""
    from ipsys_log.cli.measure_live import say_faults
    from ipsys_log.web.server import qr_code, serve

    signals: list[None] = []  # a list: an Event takes a lock that the interrupted thread may hold
    stop_on_signal(lambda: signals.append(None))
    with serve(scene, host, port) as page:
        if host is not None:
            console.print(qr_code(page.url), style="#ffffff on #000000", markup=False)
        console.print(f"open {page.url}", markup=False)
        remarks.print("Ctrl-C ends the measuring; every saved point is already in the log")
        try:
            page.wait(lambda: bool(signals))
        finally:
            say_faults(page)


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


def _show_count(log: Path, added: Sequence[Measurement], as_json: bool) -> None:
    withdrawn = sum(measurement.withdraws is not None for measurement in added)
    count = sum(measurement.is_point for measurement in added)
    if as_json:
        print(json.dumps({"log": str(log), "measured": count, "withdrawn": withdrawn}))  # noqa: T201
        return
    baselines = sum(measurement.from_reference is not None for measurement in added)
    also = f", {baselines} distance AB" if baselines else ""
    also += f", {withdrawn} withdrawn" if withdrawn else ""
    console.print(f"{count} point{'' if count == 1 else 's'} measured into {log}{also}", markup=False)


def _show_next(log: Path, history: Sequence[Measurement]) -> None:
    """Print the next step for the number of points that a log has now."""
    from ipsys_log.analysis.pairs import active_measurements
    from ipsys_log.models.table import min_pairs

    count = len(active_measurements(history))
    if not count:
        return
    if count < _GOOD:
        remarks.print(
            f"calibration points in the log: {count}; each camera must see {min_pairs(_MODEL)} or more for a "
            f"model, and about {_GOOD} for a good one",
            markup=False,
        )
    remarks.print(f"next: ipsys replay {shell_words(log)}", markup=False)


def _show_places(scene: FinishedLog, as_json: bool) -> None:
    from ipsys_log.report.contents import intervals_json, intervals_table

    stops = intervals_json(scene)
    if as_json:
        print(json.dumps(stops, indent=2))  # noqa: T201
    else:
        console.print(intervals_table(stops))
