"""Alignment of the cameras and coverage of the floor: ``ipsys align``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.open_cameras import check_target, prepare_lab, record_now
from ipsys_log.cli.options import (
    AsJson,
    Calibrations,
    Corners,
    NoLogs,
    RigFile,
    cameras_of,
    load_calibrations,
    log_argument,
    log_option,
)
from ipsys_log.cli.stages import derive

if TYPE_CHECKING:
    from ipsys_log.capture.lab import Lab
    from ipsys_log.log.location import LogLocation
    from ipsys_log.report.alignment import AlignedLab

NoOrLogs = Annotated[
    NoLogs, log_argument(help="Logs, files or URLs, read as one session. The last log gets the results.")
]
Plot = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Draw the floor map and the camera images: .png, .pdf, .svg or .jpg."),
]
Output = Annotated[
    Path | None,
    log_option(help="A new log for the results. Without LOG, it also gets the camera frames."),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(align)


def align(
    logs: NoOrLogs = None,
    rig: RigFile = None,
    calibration: Calibrations = None,
    corners: Corners = None,
    seconds: Annotated[
        float, typer.Option(min=0.1, metavar="SECONDS", help="Without LOG: duration of the recording.")
    ] = 3.0,
    plot: Plot = None,
    output: Output = None,
    as_json: AsJson = False,
) -> None:
    """Show the tilt that makes each camera look straight down, and the floor that all cameras see.

    The command uses markers that lie on the floor: four or more in each image, or one marker that is laid
    down at one calibration point after the other. If the log has calibration points, the command also reports
    the floor that no camera sees, and neighbours that overlap by less than a marker. It computes missing
    results first. Without a log, it uses the present images of the cameras of the rig.
    """
    from ipsys_log.report.files import check_figure_file

    if plot is not None:
        check_figure_file(plot, "--plot", logs or [])
    if logs:
        options: dict[str, Any] = {
            "rig": rig,
            "calibration": calibration,
            "corners": corners,
            "output": output,
        }
        _align(logs, options, plot, as_json)
        return
    lab = _prepare_now(rig, calibration, corners, output)
    with record_now(lab, seconds, output) as log:
        kept = output is not None
        options = {"rig": None, "calibration": None, "corners": corners, "kept": kept}
        _align([log], options, plot, as_json)
    if output is None:
        remarks.print("no frames or results are kept; to keep them, add -o name.mcap", markup=False)


def _prepare_now(
    rig: Path | None, calibration: list[str] | None, corners: str | None, output: Path | None
) -> Lab:
    """Return the cameras to open, after all checks that are possible before they are opened."""
    from ipsys_log.capture.live_plan import check_start
    from ipsys_log.errors import IpsysError
    from ipsys_log.runs.options import Request

    if rig is None:
        raise IpsysError("no log is given; name a log, or give --rig lab.toml to use its cameras now")
    lab = prepare_lab(rig, None, calibration)
    check_start(lab.rig, lab.names, lab.lenses, Request(corners=corners), "camera-frame")
    if output is not None:
        check_target(output, False, lab.files)
    return lab


def _align(logs: Sequence[LogLocation], options: dict[str, Any], plot: Path | None, as_json: bool) -> None:
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, RIG
    from ipsys_log.report.alignment import read_alignment
    from ipsys_log.rig.file import load_rig
    from ipsys_log.runs.graph import writes
    from ipsys_log.runs.provenance import newest_run
    from ipsys_log.sinks.selection import rig_in_force

    given_rig = load_rig(options["rig"]) if options["rig"] else None
    lenses = load_calibrations(options["calibration"], lambda: cameras_of(logs))
    with Session(logs) as session:
        bare = not session.images and newest_run(session, MARKERS) is None
    method = "perimeter" if bare else "pose"
    with derive(logs, "camera-frame", method=method, run=None, **options) as (session, outcomes, _):
        made = [outcome.run for outcome in outcomes if writes(outcome, CAMERA_POINTS)]
        run = made[-1] if made else str(newest_run(session, CAMERA_POINTS))
        recorded_lenses = {
            camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()
        }
        in_force = given_rig or rig_in_force(session, [run]) or session.payloads(session.topics(RIG))[-1]
        lab = read_alignment(session, run, in_force, {**recorded_lenses, **lenses})
    _show(lab, plot, as_json)


def _show(lab: AlignedLab, plot: Path | None, as_json: bool) -> None:
    from ipsys_log.report.alignment_text import alignment_json, alignment_table, coverage_lines

    if plot is not None:
        from ipsys_log.report.alignment_figure import draw_alignment

        draw_alignment(lab, plot)
    if as_json:
        print(json.dumps(alignment_json(lab), indent=2, allow_nan=False))  # noqa: T201
    else:
        console.print(alignment_table(lab))
        for line, good in coverage_lines(lab):
            console.print(line, style="green" if good else "red", markup=False, soft_wrap=False)
    for note in lab.notes:
        remarks.print(note, style="yellow", markup=False)
    if plot is not None:
        remarks.print(f"{plot} drawn", markup=False)
