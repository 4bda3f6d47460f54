"""Calibration points of a log: ``ipsys measure``, ``ipsys exclude`` and ``ipsys plan``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import console, print_json, print_result, progress_bar, say, warn
from ipsys_log.app.cli.lab_inputs import cameras_of, lab_of_run, load_calibrations, load_matching_rig
from ipsys_log.app.cli.options import appended_log_argument, figure_option, setting, switch
from ipsys_log.app.cli.pages import serve_measuring
from ipsys_log.app.cli.signals import SAVED, allow_interrupt, runs_until_stopped, stop_on_signal
from ipsys_log.app.cli.stages import derive
from ipsys_log.app.report.rows import counted
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.live_runs.survey.floor_plan import PlannedFloor
    from ipsys_log.live_runs.survey.scene import MeasuringScene
    from ipsys_log.messages import Measurement, Rig

Log = Annotated[Path, appended_log_argument(help="A finished log, which gets the measurements.")]
Sheet = Annotated[
    Path | None,
    setting("--csv", "SHEET", "Read the measurements from a sheet; docs/measuring.md shows the columns."),
]
Insist = Annotated[bool, switch("--force", "With --csv: write rows that look wrong, too.")]
Places = Annotated[
    bool,
    switch("--places", "Only list the stationary intervals of the markers, with their numbers for a sheet."),
]
Baseline = Annotated[
    str | None,
    setting(
        "--ab",
        "CM",
        "The distance between the first two reference points, read with this tape, in cm. It shows the "
        "scale of the tape if the rig has ab_sigma_m.",
    ),
]


@runs_until_stopped
def measure(
    log: Log,
    terminal: cli.Terminal = False,
    csv: Sheet = None,
    places: Places = False,
    ab: Baseline = None,
    host: cli.Host = None,
    port: cli.Port = 8000,
    rig: cli.RigFile = None,
    calibration: cli.Calibrations = None,
    corners: cli.Corners = None,
    force: Insist = False,
    as_json: cli.AsJson = False,
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
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.survey.from_log import open_finished_log
    from ipsys_log.live_runs.survey.sheet import add_sheet, check_sheet

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
            from ipsys_log.app.report.contents import intervals_json, intervals_table

            stops = intervals_json(scene)
            print_result(stops, [intervals_table(stops)], as_json)
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
        Path, appended_log_argument(help="A finished log with measurements, which gets the change.")
    ],
    points: Annotated[
        list[str], typer.Argument(metavar="POINT", help="Names of calibration points, such as p007.")
    ],
    reason: Annotated[
        str, setting("--reason", "TEXT", "The reason, which is written into the log. Necessary.")
    ] = "",
    readmit: Annotated[
        bool, switch("--readmit", "Use excluded points again, instead of excluding points.")
    ] = False,
    as_json: cli.AsJson = False,
) -> None:
    """Exclude calibration points of a log from all stages, or re-admit them. Nothing is erased.

    The command appends a message for each point. Models of the log are then out of date, and ipsys replay
    fits them again. A point that is excluded already causes no change.

    Examples

        ipsys exclude calibration.mcap p007 p012 --reason "the tape sagged"
        ipsys exclude calibration.mcap p012 --readmit --reason "tape was straight"
    """
    from ipsys_log.live_runs.survey import from_log

    result = (from_log.readmit if readmit else from_log.exclude)(log, points, reason)
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
    from ipsys_log.statistics.calibration_points import ENOUGH_POINTS, active_measurements

    withdrawn = sum(measurement.withdraws is not None for measurement in added)
    count = sum(measurement.is_point for measurement in added)
    if as_json:
        print_json({"log": str(log), "measured": count, "withdrawn": withdrawn})
    else:
        baselines = sum(measurement.from_reference is not None for measurement in added)
        also = f", {baselines} distance AB" if baselines else ""
        also += f", {withdrawn} withdrawn" if withdrawn else ""
        console.print(f"{counted(count, 'point')} measured into {log}{also}")
    active = len(active_measurements(history))
    if active:
        say(f"calibration points in the log: {active}; enough: {ENOUGH_POINTS}")
        say(f"next: ipsys calibrate-lab {shell_words(log)}")


_MOST_PLACES = 50
# Without a floor in the rig, this is the largest height of a marker.
_HIGHEST_M = 5.0

Count = Annotated[int, setting("--places", "N", "Number of points to propose.")]
Model = Annotated[str, setting("--model", "NAME", "The model to improve.")]
Heights = Annotated[
    list[float] | None,
    setting(
        "--height-m",
        "METRES",
        "Height of the marker above the floor, in m; repeat it for several. Default: the heights of the "
        "measured points, in turn.",
    ),
]
Plot = Annotated[Path | None, figure_option("the error over the floor, before and after")]


def plan(
    logs: cli.Logs,
    places: Count = 5,
    model: Model = "best",
    height_m: Heights = None,
    train: cli.Train = "train",
    rig: cli.RigFile = None,
    calibration: cli.Calibrations = None,
    plot: Plot = None,
    as_json: cli.AsJson = False,
) -> None:
    """Propose the next points to measure, which reduce the predicted error over the floor most.

    For the model joint, the command proposes a drive of a robot, too. Its errors are those of the calibration
    alone, without the noise of an image.

    If the log has no such model yet, the command fits one first.

    Examples

        ipsys plan calibration.mcap --places 5 --plot next.png
    """
    from ipsys_log.engine.graph import writes
    from ipsys_log.engine.request import copied_run
    from ipsys_log.messages.channels import MODEL
    from ipsys_log.messages.rig_file import load_rig

    given_rig = load_rig(rig) if rig else None
    lenses = load_calibrations(calibration, lambda: cameras_of(logs))
    _check(logs, given_rig, model, places, height_m or ())
    options: dict[str, Any] = {"train": train, "rig": rig, "calibration": calibration, "run": None}
    with derive(logs, "fit", model=[model], **options) as (session, outcomes, _):
        fitted = [outcome.run for outcome in outcomes if writes(outcome, MODEL)]
        run = fitted[-1] if fitted else str(copied_run(session, model))
        in_force, all_lenses = lab_of_run(session, run, given_rig, lenses)
        from ipsys_log.live_runs.survey.floor_plan import plan_floor  # after the bar of the fit has begun

        with progress_bar(()) as progress:
            planned = plan_floor(
                *(session, run, in_force, all_lenses, places, height_m or ()),
                progress=lambda done, total: progress("plan", done, total),
            )
    _show(planned, plot, as_json)


def _show(found: PlannedFloor, plot: Path | None, as_json: bool) -> None:
    from ipsys_log.app.report.calibration import plan_json, plan_lines, plan_table

    print_result(plan_json(found), (plan_table(found), *plan_lines(found)), as_json, found.notes)
    if plot is not None:
        from ipsys_log.app.report.expected_error_figures import draw_plan

        draw_plan(found, plot)
        say(f"{plot} drawn")


def _check(logs: cli.LogList, rig: Rig | None, model: str, places: int, heights_m: Sequence[float]) -> None:
    """Check that a plan is possible, before a model is fitted."""
    from ipsys_log.engine.request import copied_run
    from ipsys_log.engine.view import LogView
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import RIG
    from ipsys_log.statistics.calibration_points import measured

    if not 1 <= places <= _MOST_PLACES:
        raise IpsysError(
            f"--places {places}: is not between 1 and {_MOST_PLACES}; plan fewer points, measure them, and "
            "plan again"
        )
    with Session(logs) as session:
        rigs = [rig] if rig is not None else session.payloads(session.topics(RIG))
        spans_m = [
            max(checked_rig.floor.width_m, checked_rig.floor.depth_m)
            for checked_rig in rigs
            if checked_rig.floor is not None
        ]
        for height_m in heights_m:
            if not (math.isfinite(height_m) and 0 <= height_m <= max(spans_m, default=_HIGHEST_M)):
                raise IpsysError(
                    f"--height-m {height_m:g}: is not a height in this lab; give metres, such as 0.15"
                )
        if not measured(LogView(session, rig=rig)) and copied_run(session, model) is None:
            raise IpsysError(
                f"{session}: has no calibration points, so a plan is not possible; first measure about 10 "
                "points over the whole view of each camera, at the heights in use"
            )
