"""Tape measurements of a log, and their exclusion: ``ipsys measure`` and ``ipsys exclude``."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.app.cli.console import console, print_json, progress_bar, say, warn
from ipsys_log.app.cli.lab_inputs import cameras_of, load_calibrations, load_matching_rig
from ipsys_log.app.cli.options import (
    AsJson,
    Calibrations,
    Corners,
    Host,
    Port,
    RigFile,
    Terminal,
    appended_log_argument,
    named,
)
from ipsys_log.app.cli.pages import serve_measuring
from ipsys_log.app.cli.signals import SAVED, allow_interrupt, runs_until_stopped, stop_on_signal
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.live_runs.survey.from_log import FinishedLog
    from ipsys_log.live_runs.survey.scene import MeasuringScene
    from ipsys_log.messages import Measurement

Log = Annotated[Path, appended_log_argument(help="A finished log, which gets the measurements.")]
Sheet = Annotated[
    Path | None,
    named("--csv", "SHEET", "Read the measurements from a sheet; docs/measuring.md shows the columns."),
]
Insist = Annotated[bool, named("--force", None, "With --csv: write rows that look wrong, too.")]
Places = Annotated[
    bool,
    named(
        "--places", None, "Only list the stationary intervals of the markers, with their numbers for a sheet."
    ),
]
Baseline = Annotated[
    str | None,
    named(
        "--ab",
        "CM",
        "The distance between the first two reference points, read with this tape, in cm. It shows the "
        "scale of the tape if the rig has ab_sigma_m.",
    ),
]

# The model that a replay fits, and the number of calibration points that gives good results.
_MODEL, _GOOD = "poly", 40


@runs_until_stopped
def measure(
    log: Log,
    terminal: Terminal = False,
    csv: Sheet = None,
    places: Places = False,
    ab: Baseline = None,
    host: Host = None,
    port: Port = 8000,
    rig: RigFile = None,
    calibration: Calibrations = None,
    corners: Corners = None,
    force: Insist = False,
    as_json: AsJson = False,
) -> None:
    """Enter the tape measurements of a log: on a page for the phone, in the terminal, or from a sheet.

    The command goes through the stationary intervals of the markers, and appends the measurements. It checks
    each entry at once. Undo withdraws a measurement and erases nothing. To measure with live cameras:
    ipsys record --measure.

    Examples

        ipsys measure calibration.mcap                     # on a page
        ipsys measure calibration.mcap --terminal          # in this terminal
        ipsys measure calibration.mcap --csv places.csv    # from a sheet
    """
    ends = csv is not None or places or ab is not None
    allow_interrupt(None if ends else SAVED)
    from ipsys_log.engine.options import Request
    from ipsys_log.live_runs.survey.add_sheet import add_sheet, check_sheet
    from ipsys_log.live_runs.survey.from_log import open_finished_log

    if sum((terminal, csv is not None, places, ab is not None)) > 1:
        raise IpsysError("--terminal, --csv, --places and --ab cannot be used together; give one of them")
    if not (terminal or ends):
        check_installed("the measuring page needs", "starlette", "uvicorn")
    if force and csv is None:
        raise IpsysError("--force is only for --csv; leave it out")
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
            from ipsys_log.live_runs.survey.checks import read_baseline

            scene.add([read_baseline(ab, scene.rig, scene.history(), scene.start_ns)])
        elif csv is not None:
            for text in add_sheet(scene, csv, force):
                warn(text)
        elif terminal:
            from ipsys_log.app.cli.dialog import ask_places

            ask_places(scene)
        else:
            _serve(scene, host, port)
        show_measured(log, scene.history()[before:], scene.history(), as_json)
    if rig is not None:
        say(f"give --rig {rig} to ipsys replay, too: the measurements use its reference points")


def _serve(scene: MeasuringScene, host: str | None, port: int) -> None:
    """Serve the page until an interrupt."""
    signals: list[None] = []  # a list: an Event takes a lock that the interrupted thread may hold
    stop_on_signal(lambda: signals.append(None))
    with serve_measuring(scene, host, port) as page:
        console.print(f"open {page.url}")
        say("Ctrl-C ends the measuring; every saved point is already in the log")
        page.wait(lambda: bool(signals))


def exclude(
    log: Annotated[
        Path,
        appended_log_argument(help="A finished log with measurements, which gets the change."),
    ],
    points: Annotated[
        list[str],
        typer.Argument(metavar="POINT", help="Names of calibration points, such as p007."),
    ],
    reason: Annotated[str, named("--reason", "TEXT", "The reason, which is written into the log.")],
    readmit: Annotated[
        bool, named("--readmit", None, "Use excluded points again, instead of excluding points.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Exclude calibration points of a log from all stages, or re-admit them. Nothing is erased.

    The command appends a message for each point. Models of the log are then out of date, and ipsys replay
    fits them again. A point that is excluded already causes no change.

    Examples

        ipsys exclude calibration.mcap p007 p012 --reason "the tape sagged"
        ipsys exclude calibration.mcap p012 --readmit --reason "tape was straight"
    """
    from ipsys_log.live_runs.survey import exclusion

    result = (exclusion.readmit if readmit else exclusion.exclude)(log, points, reason)
    done, before = ("re-admitted", "not excluded") if readmit else ("excluded", "excluded already")
    for name, text in result.unchanged.items():
        warn(f"{name} is {before}{f': {text}' if text else ''}")
    if as_json:
        key = "readmitted" if readmit else "excluded"
        rows = {"log": str(log), key: result.changed, "unchanged": [*result.unchanged]}
        print_json({**rows, "active": result.active})
        return
    if not result.changed:
        console.print(f"{log} is unchanged")
        return
    console.print(f"{done}: {', '.join(result.changed)}; calibration points in use: {result.active}")
    say(f"next: ipsys replay {shell_words(log)}")


def show_measured(
    log: Path, added: Sequence[Measurement], history: Sequence[Measurement], as_json: bool
) -> None:
    """Print the number of added measurements, and the next step for the points that a log has now."""
    from ipsys_log.models.table import min_pairs
    from ipsys_log.statistics.pairs import active_measurements

    withdrawn = sum(measurement.withdraws is not None for measurement in added)
    count = sum(measurement.is_point for measurement in added)
    if as_json:
        print_json({"log": str(log), "measured": count, "withdrawn": withdrawn})
    else:
        baselines = sum(measurement.from_reference is not None for measurement in added)
        also = f", {baselines} distance AB" if baselines else ""
        also += f", {withdrawn} withdrawn" if withdrawn else ""
        console.print(f"{count} point{'' if count == 1 else 's'} measured into {log}{also}")
    active = len(active_measurements(history))
    if 0 < active < _GOOD:
        say(
            f"calibration points in the log: {active}; each camera must see {min_pairs(_MODEL)} or more for "
            f"a model, and about {_GOOD} for a good one"
        )
    if active:
        say(f"next: ipsys replay {shell_words(log)}")


def _show_places(scene: FinishedLog, as_json: bool) -> None:
    from ipsys_log.app.report.contents import intervals_json, intervals_table

    stops = intervals_json(scene)
    if as_json:
        print_json(stops)
    else:
        console.print(intervals_table(stops))
