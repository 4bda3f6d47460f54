"""Calibration of the markers of a body: ``ipsys calibrate-body``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import print_result, say
from ipsys_log.app.cli.options import check_present, log_option, option, with_options
from ipsys_log.app.report.rows import Rows, wrap_text
from ipsys_log.errors import IpsysError

if TYPE_CHECKING:
    from ipsys_log.calibration.joint.body_calibration import BodyCalibration

_FEW_LINKED = 10
_TIME = "UTC, such as '2026-05-04 10:00:00', or seconds from the start of the log."
_OPTIONS: dict[str, cli.Option] = {
    "logs": (cli.Logs, cli.REQUIRED),
    "robot": option(str | None, "--robot", "NAME", "The robot of the body. Default: the only body."),
    "start": option(str, "--start", "TIME", f"Use frames from this time on: {_TIME}", ""),
    "end": option(str, "--end", "TIME", f"Use frames before this time: {_TIME}", ""),
    "rig": (cli.RigFile, None),
    "write": option(
        Path | None, "--write", "FILE",
        "Write the poses and sides into this rig file, such as lab.toml, which names the markers.",
    ),
    "output": (Annotated[Path | None, log_option(help="A new log for the results.")], None),
    "as_json": (cli.AsJson, False),
}  # fmt: skip


@with_options(_OPTIONS)
@cli.needs_local_files
def calibrate_body(
    logs: Any,
    robot: str | None,
    start: str,
    end: str,
    rig: Path | None,
    write: Path | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Estimate the poses of the markers on a body, and their printed sides, from carrying it.

    Carry the body below the cameras for 20 s, and turn it: images must show two or more of its markers. The
    log needs markers and the model joint. The poses are those in the axes of the first marker of the body in
    the rig. The command appends the rig with the results to the log, as a run.

    Examples

        ipsys calibrate-body carry.mcap --robot drone --write lab.toml
        ipsys calibrate-body lab.mcap carry.mcap        # the model is in lab.mcap
        ipsys calibrate-body carry.mcap --start 5 --end 25
    """
    from ipsys_log.app.report.json_format import plain
    from ipsys_log.engine.output import append_run, choose_target, open_target
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.rig_file import load_rig
    from ipsys_log.sinks.selection import rig_in_force
    from ipsys_log.tools.carried_lab import calibrate_carried_body

    check_present(logs)
    if rig is not None and write is not None:
        raise IpsysError("--rig and --write cannot be used together; --write also reads its file")
    path = write or rig
    given = None if path is None else load_rig(path)
    logs, target = choose_target(logs, output)
    with Session(logs) as session:
        used = given or rig_in_force(session, [])
        if robot is None:
            names = [body.robot for body in used.bodies] if used is not None else []
            if len(names) != 1:
                raise IpsysError(
                    f"the rig has the bodies {', '.join(names) or 'none'}; name one with --robot"
                )
            robot = names[0]
        body, record, message = calibrate_carried_body(session, robot, used, start, end)
    with open_target(logs, target) as (_, log):
        append_run(log, record, message.log_time_ns, lambda: [message], {})
    result = {key: value for key, value in plain(body).items() if key != "covariance"}
    print_result({"run": record.run, **result}, [_table(body), *_lines(body)], as_json)
    say(f"run {record.run} written to {target or log}")
    if write is not None:
        from ipsys_log.app.first_day.rig_entry import replace_tables, write_rig

        new, text = message.payload, write.read_text(encoding="utf-8")
        for header, items in (("[[markers]]", new.markers), ("[[bodies]]", new.bodies)):
            text = replace_tables(text, header, items)
        write_rig(write, text, new)
        say(f"{write}: has the poses and sides of {robot}; it applies to new recordings, and with --rig")


def _table(body: BodyCalibration) -> Rows:
    cells = []
    for marker in body.markers:
        numbers = [f"{round(1000 * x, 2) + 0.0:.2f}" for x in (*marker.xyz_m, max(marker.xyz_sigmas_m))]
        angles = (*marker.rpy_rad, max(marker.turn_sigmas_rad))
        numbers += [f"{round(math.degrees(angle), 3) + 0.0:.3f}" for angle in angles]
        cells.append([str(marker.id), *numbers, f"{1000 * marker.length_m:.2f}", str(marker.frames)])
    heads = ["marker", *(f">{name}" for name in ("x", "y", "z", "±", "roll", "pitch", "yaw", "±"))]
    note = "Lengths in mm, angles in degrees; ±: the largest standard deviation, without that of the size"
    return Rows(f"{body.robot}: markers on the body", [*heads, ">side", ">frames"], cells, note)


def _lines(body: BodyCalibration) -> list[str]:
    source = f"the prints, and {body.linked_frames} of {body.frames} frames just after another camera's"
    size = f"Size of the body: ± {100 * body.scale_sigma:.3f} % (scale_sigma), by {source}."
    if body.linked_frames < _FEW_LINKED:
        size += " Carry it where two cameras see it: their distance gives a better size."
    return [wrap_text(line) for line in (size, *(f"Warning: {remark}." for remark in body.remarks))]
