"""Poses of the cameras: ``ipsys align`` shows them, ``ipsys drift`` shows their changes over weeks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.text import Text

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import print_result, progress_bar, say
from ipsys_log.app.cli.lab_inputs import cameras_of, lab_of_run, load_calibrations
from ipsys_log.app.cli.open_cameras import check_target, prepare_lab, record_now
from ipsys_log.app.cli.options import (
    figure_option,
    log_argument,
    log_option,
    other_log_option,
    setting,
    switch,
)
from ipsys_log.app.cli.stages import derive
from ipsys_log.app.report.rows import wrap_text
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.app.report.alignment import AlignedLab
    from ipsys_log.capture.lab import Lab
    from ipsys_log.live_runs.survey.drift_reading import DriftReading

NoOrLogs = Annotated[
    cli.NoLogs, log_argument(help="Logs, files or URLs, read as one session. The last log gets the results.")
]
Output = Annotated[
    Path | None, log_option(help="A new log for the results. Without LOG, it also gets the camera frames.")
]
Sources = Annotated[
    cli.LogList, log_argument(help="Logs of one lab, files or URLs, in any order. Each is read on its own.")
]
Baseline = Annotated[
    cli.OtherLog, other_log_option("--baseline", help="The log before all moves. Default: the first by time.")
]
ModelLog = Annotated[
    cli.OtherLog,
    other_log_option(
        "--model-from", help="The log with the fitted model. Default: the baseline, if it has one."
    ),
]
Fix = Annotated[
    bool,
    switch(
        "--fix",
        "Append the joint model with the new poses of the moved cameras to the last log, as a new run.",
    ),
]


def align(
    logs: NoOrLogs = None,
    rig: cli.RigFile = None,
    calibration: cli.Calibrations = None,
    corners: cli.Corners = None,
    seconds: Annotated[
        float, setting("--seconds", "SECONDS", "Without LOG: duration of the recording.", min=0.1)
    ] = 3.0,
    plot: Annotated[Path | None, figure_option("the floor map and the camera images")] = None,
    output: Output = None,
    as_json: cli.AsJson = False,
) -> None:
    """Show the tilt that makes each camera look straight down, and the floor that all cameras see.

    The command uses markers that lie on the floor: four or more in each image, or one marker that is laid
    down at one calibration point after the other. If the log has calibration points, the command also reports
    the floor that no camera sees, and neighbours that overlap by less than a marker. It computes missing
    results first. Without a log, it uses the present images of the cameras of the rig.

    Examples

        ipsys align --rig lab.toml                     # use the cameras now
        ipsys align monday.mcap --plot alignment.png   # of a log, with a figure
    """
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
        say("no frames or results are kept; to keep them, add -o name.mcap")


def _prepare_now(
    rig: Path | None, calibration: list[str] | None, corners: str | None, output: Path | None
) -> Lab:
    """Return the cameras to open, after all checks that are possible before they are opened."""
    from ipsys_log.capture.live_plan import check_start
    from ipsys_log.engine.request import Request

    if rig is None:
        raise IpsysError("no log is given; name a log, or give --rig lab.toml to use its cameras now")
    lab = prepare_lab(rig, None, calibration)
    check_start(lab.rig, lab.names, lab.lenses, Request(corners=corners), "camera-frame")
    if output is not None:
        check_target(output, False, lab.files)
    return lab


def _align(logs: Sequence[LogLocation], options: dict[str, Any], plot: Path | None, as_json: bool) -> None:
    from ipsys_log.app.report.alignment import read_alignment
    from ipsys_log.engine.graph import writes
    from ipsys_log.engine.provenance import newest_run
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS
    from ipsys_log.messages.rig_file import load_rig

    given_rig = load_rig(options["rig"]) if options["rig"] else None
    lenses = load_calibrations(options["calibration"], lambda: cameras_of(logs))
    with Session(logs) as session:
        bare = not session.images and newest_run(session, MARKERS) is None
    method = "perimeter" if bare else "pose"
    with derive(logs, "camera-frame", method=method, run=None, **options) as (session, outcomes, _):
        made = [outcome.run for outcome in outcomes if writes(outcome, CAMERA_POINTS)]
        run = made[-1] if made else str(newest_run(session, CAMERA_POINTS))
        in_force, all_lenses = lab_of_run(session, run, given_rig, lenses)
        lab = read_alignment(session, run, in_force, all_lenses)
    _show(lab, plot, as_json)


def _show(lab: AlignedLab, plot: Path | None, as_json: bool) -> None:
    from ipsys_log.app.report.camera_poses import alignment_json, alignment_table, coverage_lines

    parts = (alignment_table(lab), *_marked(coverage_lines(lab)))
    print_result(alignment_json(lab), parts, as_json, lab.notes)
    if plot is not None:
        from ipsys_log.app.report.camera_pose_figures import draw_alignment

        draw_alignment(lab, plot)
        say(f"{plot} drawn")


def _marked(lines: Iterable[tuple[str, bool]]) -> Iterator[Text]:
    """Yield lines of at most 80 columns, in green if they are good, else in red."""
    return (Text(wrap_text(line), "green" if is_good else "red") for line, is_good in lines)


def drift(
    logs: Sources,
    baseline: Baseline = None,
    model_from: ModelLog = None,
    rig: cli.RigFile = None,
    fix: Fix = False,
    plot: Annotated[Path | None, figure_option("the drift over time")] = None,
    as_json: cli.AsJson = False,
) -> None:
    """Show which camera moved, when, and by how much its positions are wrong since then.

    The command compares reference markers, which are fixed to the floor or to a wall, in logs of weeks. The
    rig lists them under reference_markers. Without them, it uses robots that drive, with the model joint. It
    finds a mean shift of the floor map from 2 mm on.

    Examples

        ipsys drift week*.mcap --plot drift.png            # which camera moved?
        ipsys drift week*.mcap --model-from calibration.mcap --rig lab.toml
        ipsys drift week*.mcap --fix                       # correct its pose
    """
    from ipsys_log.live_runs.survey.drift_reading import read_drift
    from ipsys_log.messages.rig_file import load_rig

    lab = load_rig(rig) if rig is not None else None
    with progress_bar(()) as progress:
        reading = read_drift(
            logs, baseline, model_from, lab, lambda done, total: progress("logs", done, total)
        )
    run = _fix(reading) if fix else None
    _print(reading, run, as_json)
    if plot is not None:
        from ipsys_log.app.report.camera_pose_figures import draw_drift

        draw_drift(reading, plot)
        say(f"{plot} drawn")


def _fix(reading: DriftReading) -> str | None:
    """Append the mended model to the last log; return its run, or None if no camera has moved."""
    from ipsys_log.calibration.joint.payload import PoseChange
    from ipsys_log.engine.mended_model import append_mended_model

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
    from ipsys_log.app.report.camera_poses import drift_json, drift_lines, drift_table

    result = {**drift_json(reading), **({} if run is None else {"mended_run": run})}
    parts = (*_marked(drift_lines(reading)), "", drift_table(reading))
    print_result(result, parts, as_json, reading.remarks)
