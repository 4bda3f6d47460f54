"""Drift of cameras over weeks: ``ipsys drift``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.cli.console import console, print_json, progress_bar, say, warn
from ipsys_log.cli.options import AsJson, LogList, OtherLog, RigFile, log_argument, other_log_option
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.survey.drift_reading import DriftReading

Sources = Annotated[
    LogList,
    log_argument(help="Logs of one lab, files or URLs, in any order. Each is read on its own."),
]
Baseline = Annotated[
    OtherLog,
    other_log_option("--baseline", help="The log before all moves. Default: the first by time."),
]
ModelLog = Annotated[
    OtherLog,
    other_log_option(
        "--model-from",
        help="The log with the fitted model. Default: the baseline, if it has one.",
    ),
]
Fix = Annotated[
    bool,
    typer.Option(
        "--fix",
        help="Append the joint model with the new poses of the moved cameras to the last log, as a new run.",
    ),
]
Plot = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Draw the drift over time: .png, .pdf, .svg or .jpg."),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(drift)


def drift(
    logs: Sources,
    baseline: Baseline = None,
    model_from: ModelLog = None,
    rig: RigFile = None,
    fix: Fix = False,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Show which camera moved, when, and by how much its positions are wrong since then.

    The command compares reference markers, which are fixed to the floor or to a wall, in logs of weeks. The
    rig lists them under reference_markers. It finds a mean shift of the floor map from 2 mm on.
    """
    from ipsys_log.report.files import check_figure_file
    from ipsys_log.rig.file import load_rig
    from ipsys_log.survey.drift_reading import read_drift

    if plot is not None:
        check_figure_file(plot, "--plot", logs)
    lab = load_rig(rig) if rig is not None else None
    with progress_bar(()) as progress:
        reading = read_drift(
            logs, baseline, model_from, lab, lambda done, total: progress("logs", done, total)
        )
    run = _fix(reading) if fix else None
    _print(reading, run, as_json)
    if plot is not None:
        from ipsys_log.report.drift_figure import draw_drift

        draw_drift(reading, plot)
        say(f"{plot} drawn")


def _fix(reading: DriftReading) -> str | None:
    """Append the mended model to the last log; return its run, or None if no camera has moved."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.joint.payload import PoseChange
    from ipsys_log.runs.mended_model import append_mended_model

    moved = reading.moved()
    if not moved:
        say("no camera has moved at the end of the logs; there is nothing to fix")
        return None
    changes = {camera: PoseChange(motion.motion, motion.covariance) for camera, motion in moved.items()}
    ends_ns = [state.time_ns for camera in moved for state in reading.drift.of_camera(camera)]
    steps_ns = [move.after_ns for move in reading.drift.moves if move.camera in moved]
    valid_from_ns = max(steps_ns, default=max(ends_ns))
    last = reading.paths[-1]
    if not isinstance(last, Path):
        raise IpsysError(f"{last}: nothing can be appended to a log at a URL; download the log for --fix")
    run = append_mended_model(last, reading.source, reading.paths[0], changes, valid_from_ns)
    say(
        f"{reading.paths[-1]}: run {run} has the model with the new poses of {', '.join(changes)}; to use "
        f"it: ipsys live --model-from {shell_words(reading.paths[-1])} --model joint"
    )
    return run


def _print(reading: DriftReading, run: str | None, as_json: bool) -> None:
    from ipsys_log.report.drift import drift_json, drift_lines, drift_table

    if as_json:
        result = {**drift_json(reading), **({} if run is None else {"mended_run": run})}
        print_json(result)
    else:
        for line, is_good in drift_lines(reading):
            console.print(line, style="green" if is_good else "red")
        console.print()
        console.print(drift_table(reading))
    for remark in reading.remarks:
        warn(remark)
