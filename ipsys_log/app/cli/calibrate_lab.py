"""Calibration of a whole lab from drives and a few taped points: ``ipsys calibrate-lab``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ipsys_log.app.cli import lab_inputs
from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.calibrate import Dictionary, Inverted, MarkerScale
from ipsys_log.app.cli.console import print_result, progress_bar, say
from ipsys_log.app.cli.open_cameras import check_target, open_cameras, prepare_lab
from ipsys_log.app.cli.options import figure_option, log_argument, log_option, setting, switch
from ipsys_log.app.cli.record import live_scene, ready_to_measure, serve_live_measuring
from ipsys_log.app.cli.stages import derive
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogLocation

if TYPE_CHECKING:
    from ipsys_log.calibration.board import Board
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.survey.lab_calibration import LabCalibration
    from ipsys_log.messages import Rig
    from ipsys_log.sinks.sink import Sink

# Largest goal that still means something, in mm.
_MOST_GOAL_MM = 1000.0

Goal = Annotated[float, setting("--goal-mm", "MM", "Wanted mean error over the floor of each camera, in mm.")]
Output = Annotated[
    Path | None,
    log_option(help="Write the results to a new log, not to the last LOG. Without LOG: the log to record."),
]
Plot = Annotated[Path | None, figure_option("the expected error over the floor of each camera")]

Sources = Annotated[
    cli.NoLogs,
    log_argument(
        help="Logs, files or URLs, read as one session. The last log gets the results. Without LOG: use the "
        "cameras of --rig now."
    ),
]
Seconds = Annotated[
    float | None, setting("--seconds", "SECONDS", "Without LOG: stop the cameras after this time.", min=1.0)
]
Terminal = Annotated[
    bool,
    switch(
        "--terminal",
        "Without LOG: ask for the measured points in the terminal after the drive, not on a page.",
    ),
]
CarriedBody = Annotated[
    str | None,
    setting(
        "--body", "ROBOT", "Use this body of the rig, which is carried by hand. Cameras may hang on walls."
    ),
]
CarriedBoard = Annotated[
    str | None,
    setting(
        "--board", "COLUMNSxROWS", "Use a board in the frames that is carried by hand, such as charuco:4x5."
    ),
]
Square = Annotated[
    float | None, setting("--square", "METRES", "Side of a square of --board, in m: the unit of all lengths.")
]
_LEAST_POINTS = 2


def calibrate_lab(
    logs: Sources = None,
    goal_mm: Goal = 3.0,
    body: CarriedBody = None,
    board: CarriedBoard = None,
    square: Square = None,
    marker_scale: MarkerScale = 0.75,
    dictionary: Dictionary = "DICT_4X4_50",
    inverted: Inverted = False,
    focal: lab_inputs.Focal = None,
    field_of_view: lab_inputs.FieldOfView = None,
    train: cli.Train = "train",
    rig: cli.RigFile = None,
    calibration: cli.Calibrations = None,
    corners: cli.Corners = None,
    output: Output = None,
    plot: Plot = None,
    save_nominal: lab_inputs.SaveNominal = None,
    seconds: Seconds = None,
    terminal: Terminal = False,
    host: cli.Host = None,
    port: cli.Port = 8000,
    force: cli.Force = False,
    as_json: cli.AsJson = False,
) -> None:
    """Calibrate all cameras of a lab together, from drives of robots and a few measured points.

    The command fits the model joint, prints the expected error over the floor, and says whether it is enough.
    If it is not, the command names points to measure and a part of the floor to drive through. Without a
    tape: lay a marker on each of two reference points, and enter 0 as its distance.

    With --body or --board, no camera needs a level floor in view. Carry the body through the fields of view,
    where two cameras see it. Then lay it down for 3 s: it defines the coordinates of the lab, unless there
    are two measured points. The command estimates poses, intrinsics and clocks of all cameras.

    Without LOG, the command records the cameras of --rig into -o until Ctrl-C. Meanwhile it prints the
    expected error, and takes the measured points on a page.

    Examples

        ipsys calibrate-lab drive.mcap cal.mcap --plot floor.png
        ipsys calibrate-lab lab.mcap --goal-mm 2           # is 2 mm reached?
        ipsys calibrate-lab lab.mcap --field-of-view 105   # without a chessboard
        ipsys calibrate-lab carry.mcap --body wand         # cameras on walls
        ipsys calibrate-lab board.mcap --board charuco:4x5 --square 0.054
    """
    from ipsys_log.calibration.board import parse_board
    from ipsys_log.engine.graph import writes
    from ipsys_log.engine.request import Request
    from ipsys_log.messages.channels import MODEL

    if not 0 < goal_mm <= _MOST_GOAL_MM:
        raise IpsysError(f"--goal-mm {goal_mm:g}: is not a length above 0 and up to {_MOST_GOAL_MM:g} mm")
    nominal = [("--focal", text) for text in focal or []]
    nominal += [("--field-of-view", text) for text in field_of_view or []]
    if logs:
        for name, value in {"seconds": seconds, "terminal": terminal, "host": host, "force": force}.items():
            if value:
                raise IpsysError(f"--{name} is only for live cameras; leave out LOG or this option")
    else:
        if output is None:
            raise IpsysError("no log is given; name a log, or give --rig lab.toml -o lab.mcap to use cameras")
        page = None if terminal else (host, port)
        request, goal_m = Request(corners=corners), goal_mm / 1000
        _record_drive(output, rig, calibration, nominal, request, goal_m, seconds, page, force)
        # The log has the rig and the intrinsics of its cameras.
        logs, output, rig, calibration, nominal = [output], None, None, None, []
    given_rig = lab_inputs.load_matching_rig(rig, lambda: lab_inputs.cameras_of(logs))
    if board is None:
        _check(logs, given_rig)
    lenses = lab_inputs.load_calibrations(calibration, lambda: lab_inputs.cameras_of(logs))
    nominal_values = lab_inputs.nominal_lenses_of_logs(logs, lenses, nominal)
    if save_nominal is not None:
        lab_inputs.write_nominal(nominal_values, save_nominal)
    lenses = {**lenses, **nominal_values}
    given: dict[str, Any] = {"model": ["joint"], "lenses": lenses, "train": train}
    given |= {"rig": rig, "calibration": None, "corners": corners, "run": None}
    if body is not None or board is not None:
        if plot is not None or (body is not None and board is not None):
            other = "--plot" if plot is not None else "--board"
            raise IpsysError(f"{other} cannot be used with {'--board' if body is None else '--body'}")
        if board is not None and square is None:
            raise IpsysError(
                "--board: add --square, the side of a square in m: it is the unit of all lengths"
            )
        carried = body or parse_board(board or "", square or 0.0, marker_scale, dictionary, inverted)
        _calibrate_carried(logs, carried, given_rig, given, output, as_json)
        return
    with derive(logs, "fit", output, **given) as (session, outcomes, _):
        run = next(outcome.run for outcome in reversed(outcomes) if writes(outcome, MODEL))
        in_force, all_lenses = lab_inputs.lab_of_run(session, run, given_rig, lenses)
        with progress_bar() as progress:
            from ipsys_log.live_runs.survey.lab_calibration import describe_lab  # after the bar has begun

            lab = describe_lab(
                session, run, in_force, all_lenses, (given_rig, lenses), train, goal_mm / 1000,
                lambda done, total: progress("describe", done, total),
            )  # fmt: skip
        _show(lab, plot, as_json)


def _calibrate_carried(
    logs: Sequence[LogLocation],
    body: str | Board,
    rig: Rig | None,
    given: dict[str, Any],
    output: Path | None,
    as_json: bool,
) -> None:
    """Calibrate the cameras from a carried body, after its detection, and append the model."""
    from ipsys_log.app.report.calibration import carried_json, carried_lines, carried_table
    from ipsys_log.engine.output import append_run, choose_target, open_target
    from ipsys_log.engine.provenance import newest_run
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import MARKERS
    from ipsys_log.tools.carried_lab import calibrate_carried_lab, calibrate_with_board

    with Session(logs) as session:
        has_images = bool(session.images)
    if has_images and isinstance(body, str):  # without images, another program has detected the markers
        with derive(logs, "detect", output, **given):
            pass
    sources, target = choose_target(logs, output)
    if target is not None and target.exists():
        sources, target = [*sources, target], None
    with Session(sources) as session, progress_bar() as progress:
        if isinstance(body, str):
            run = newest_run(session, MARKERS) or ""
            in_force, lenses = lab_inputs.lab_of_run(session, run, rig, given["lenses"])
            lab, record, message = calibrate_carried_lab(session, body, in_force, lenses, progress)
        else:
            lenses = lab_inputs.lenses_of(session, given["lenses"])
            lab, record, message = calibrate_with_board(session, body, lenses, progress)
    with open_target(sources, target) as (_, log):
        append_run(log, record, message.log_time_ns, lambda: [message], {})
    print_result({"run": record.run, **carried_json(lab)}, [carried_table(lab), *carried_lines(lab)], as_json)
    say(f"run {record.run} written to {target or log}")
    say(f"next: ipsys replay OTHER.mcap --model-from {target or log} --model joint")


def _check(logs: Sequence[LogLocation], rig: Rig | None) -> None:
    """Check that the logs have a rig and a marker or an image, before any stage runs."""
    from ipsys_log.engine.provenance import newest_run
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import MARKERS, RIG

    with Session(logs) as session:
        if rig is None and not session.topics(RIG):
            raise IpsysError(
                f"{session}: has no rig (markers, reference points); give one with --rig lab.toml"
            )
        if not session.images and newest_run(session, MARKERS) is None:
            raise IpsysError(
                f"{session}: has no images and no markers; record a drive with ipsys record -o drive.mcap"
            )


def _show(lab: LabCalibration, plot: Path | None, as_json: bool) -> None:
    from ipsys_log.app.report.calibration import lab_advice, lab_headline, lab_json, lab_table

    parts = (*lab_headline(lab), "", lab_table(lab), *lab_advice(lab))
    print_result(lab_json(lab), parts, as_json, lab.notes)
    if plot is not None:
        from ipsys_log.app.report.expected_error_figures import draw_lab

        draw_lab(lab, plot)
        say(f"{plot} drawn")


def _record_drive(
    output: Path,
    rig: Path | None,
    calibration: list[str] | None,
    nominal: Sequence[tuple[str, str]],
    request: Request,
    goal_m: float,
    seconds: float | None,
    page: tuple[str | None, int] | None,
    force: bool,
) -> None:
    """Record the cameras of a rig with their markers, until a signal; then ask for missing points.

    Parameters
    ----------
    nominal : options for nominal intrinsics, with their texts.
    goal_m : wanted mean error of every camera.
    page : address and port of the measuring page; None: the terminal asks after the recording.
    """
    from ipsys_log.live_runs import pipeline
    from ipsys_log.live_runs.survey.live_calibration import LiveCalibration

    if page is not None:
        check_installed("the measuring page needs", "starlette", "uvicorn")
    lab = prepare_lab(rig or Path("lab.toml"), None, calibration)
    sizes_px = {c.name: (c.width, c.height) for c in lab.cameras if c.width and c.height}
    lab.lenses.update(lab_inputs.nominal_lenses(nominal, lab.names, lab.lenses, sizes_px))
    check_target(output, force, lab.files)
    ready_to_measure(lab, request, None, page)
    with open_cameras(lab, output, seconds) as (opened, status):
        scene = live_scene(opened, None)
        calibrating = LiveCalibration(lab.rig, lab.lenses, goal_m, say)
        sinks: list[Sink] = [status, scene, calibrating]
        try:
            with nullcontext() if page is None else serve_live_measuring(scene, *page):
                pipeline.live(opened.cameras, opened.settings, output, request, "camera-frame", sinks, force)
        finally:
            calibrating.close()
    if page is None or (len(scene.history()) < _LEAST_POINTS and sys.stdin.isatty()):
        _ask_points(output, request)


def _ask_points(output: Path, request: Request) -> None:
    """Ask for the points of the stationary intervals in the terminal."""
    from ipsys_log.app.cli.dialog import ask_places
    from ipsys_log.live_runs.survey.from_log import open_finished_log

    with progress_bar() as progress, open_finished_log(output, request, progress, say) as scene:
        say(
            f"measure {_LEAST_POINTS} to 4 of the points at which a marker was stationary; s skips a point, "
            "q ends"
        )
        ask_places(scene)
