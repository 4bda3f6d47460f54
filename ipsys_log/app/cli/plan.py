"""Planning of the next calibration points: ``ipsys plan``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ipsys_log.app.cli.console import console, print_json, say, warn
from ipsys_log.app.cli.lab_inputs import cameras_of, lab_of_run, load_calibrations
from ipsys_log.app.cli.options import (
    AsJson,
    Calibrations,
    LogList,
    Logs,
    RigFile,
    Train,
    figure_option,
    named,
)
from ipsys_log.app.cli.stages import derive
from ipsys_log.errors import IpsysError

if TYPE_CHECKING:
    from ipsys_log.live_runs.survey.floor_plan import PlannedFloor
    from ipsys_log.messages import Rig

_MOST_PLACES = 50
# Without a floor in the rig, this is the largest height of a marker.
_HIGHEST_M = 5.0

Places = Annotated[int, named("--places", "N", "Number of points to propose.")]
Model = Annotated[str, named("--model", "NAME", "The model to improve.")]
Heights = Annotated[
    list[float] | None,
    named(
        "--height-m",
        "METRES",
        "Height of the marker above the floor, in m; repeat it for several. Default: the heights of the "
        "measured points, in turn.",
    ),
]
Plot = Annotated[Path | None, figure_option("the error over the floor, before and after")]


def plan(
    logs: Logs,
    places: Places = 5,
    model: Model = "best",
    height_m: Heights = None,
    train: Train = "train",
    rig: RigFile = None,
    calibration: Calibrations = None,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Propose the next points to measure, which reduce the predicted error over the floor most.

    For the model joint, the command proposes a drive of a robot, too. Its errors are those of the calibration
    alone, without the noise of an image.

    If the log has no such model yet, the command fits one first.

    Examples

        ipsys plan calibration.mcap --places 5 --plot next.png
    """
    from ipsys_log.engine.graph import writes
    from ipsys_log.engine.select import copied_run
    from ipsys_log.live_runs.survey.floor_plan import plan_floor
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
        planned = plan_floor(session, run, in_force, all_lenses, places, height_m or ())
    _show(planned, plot, as_json)


def _show(found: PlannedFloor, plot: Path | None, as_json: bool) -> None:
    from ipsys_log.app.report.expected_error_texts import plan_json, plan_lines, plan_table

    if plot is not None:
        from ipsys_log.app.report.expected_error_figures import draw_plan

        draw_plan(found, plot)
    if as_json:
        print_json(plan_json(found))
    else:
        for part in (plan_table(found), *plan_lines(found)):
            console.print(part)
    for note in found.notes:
        warn(note)
    if plot is not None:
        say(f"{plot} drawn")


def _check(logs: LogList, rig: Rig | None, model: str, places: int, heights_m: Sequence[float]) -> None:
    """Check that a plan is possible, before a model is fitted."""
    from ipsys_log.engine.select import copied_run
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
