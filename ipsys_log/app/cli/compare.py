"""``ipsys compare``: score a robot's own estimates against its tracks."""

from pathlib import Path
from typing import Annotated, Any

import typer

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import print_result, progress_bar, say
from ipsys_log.app.cli.options import check_present, figure_option, flag, log_option, option, with_options
from ipsys_log.errors import IpsysError

_LOG = cli.log_argument(
    callback=cli._location, help="The log with the tracks; it gets a run of each estimate."
)
_ESTIMATES = typer.Argument(
    metavar="ESTIMATE",
    callback=cli.read_files,
    help="Bags of ROS, .tum, .csv and other trajectories, or logs. Without one: show what LOG has.",
)
_OPTIONS: dict[str, cli.Option] = {
    "log": (Annotated[cli.OneLog, _LOG], cli.REQUIRED),
    "estimates": (Annotated[list[Path] | None, _ESTIMATES], None),
    "robot": option(
        list[str] | None, "--robot", "NAME[=BODY]",
        "The robot of an estimate, in the order of the files, or of a body. Default: the one that fits.",
    ),
    "run": option(str | None, "--run", "NAME", "Use the tracks of this run. Default: the newest."),
    "topic": option(str | None, "--topic", "TOPIC", "The topic of the estimates in bags."),
    "align": option(
        str, "--align", "2d|3d|none", "Align the coordinates on the floor (2d), in space (3d), or not.", "2d"
    ),
    "time_offset": option(str | None, "--time-offset", "S", "Add this to the times, instead of an estimate."),
    "pivot": option(
        str | None, "--pivot", "X,Y,Z",
        "From the marker to the body in m, in the axes of the marker, instead of an estimate.",
    ),
    "scale": flag("--scale", "Estimate and apply a scale, as for monocular SLAM."),
    "time_unit": option(str | None, "--time-unit", "s|ns", "Unit of a time column whose header has none."),
    "length_unit": option(str | None, "--length-unit", "m|mm", "Unit of x, y and z whose header has none."),
    "write": option(Path | None, "--write", "FILE", "Write the pivot of the robot into this rig file."),
    "plot": (Annotated[Path | None, figure_option("paths, and errors over time and distance")], None),
    "output": (Annotated[Path | None, log_option(help="A new log for the results.")], None),
    "as_json": (cli.AsJson, False),
}  # fmt: skip


@with_options(_OPTIONS)
def compare(
    log: Any,
    estimates: list[Path] | None,
    write: Path | None,
    plot: Path | None,
    output: Path | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Score a robot's own estimates against its tracks, which are the ground truth.

    An estimate is the odometry, SLAM or filter of the robot. The command estimates its clock, its
    coordinates, and the pivot and the turn of its body relative to the marker. It prints ATE and RPE as evo
    defines them, coverage and drift. It appends the estimate to the log, as a run.

    Examples

        ipsys compare monday.mcap odom.tum
        ipsys compare monday.mcap bag --robot ada=/odom --plot ada.png
        ipsys compare monday.mcap                     # what the log has
    """
    from ipsys_log.app.report.comparison import comparison_json, comparison_lines, comparison_table
    from ipsys_log.engine.output import choose_target
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.rig_file import load_rig
    from ipsys_log.sinks.selection import rig_in_force
    from ipsys_log.tools import comparison as tool

    check_present([log])
    options = _read_options(given)
    logs, target = choose_target([log], output)
    with Session(logs) as session:
        if estimates:
            with progress_bar(("bag",)) as progress:
                found = tool.compare(session, estimates, options, say, progress)
        elif not (found := tool.read_comparisons(session, options.run)):
            raise IpsysError(f"{session}: has no comparison; name a file with an estimate")
        rig = rig_in_force(
            session, [run for one in found for run in (one.record.run, *one.record.input_runs)]
        )
    written = tool.append_comparisons(logs, target, found)
    parts = [part for one in found for part in (comparison_table(one), *comparison_lines(one), "")]
    print_result({"comparisons": [comparison_json(one) for one in found]}, parts[:-1], as_json)
    if plot is not None:
        from ipsys_log.app.report.comparison_figures import draw_comparisons

        draw_comparisons(found, rig, plot)
        say(f"{plot} drawn")
    if write is not None:
        from ipsys_log.app.first_day.rig_entry import replace_tables, write_rig

        changed = load_rig(write)
        for one in found:
            changed = tool.move_pivot(changed, one, rig)
        write_rig(
            write, replace_tables(write.read_text(encoding="utf-8"), "[[bodies]]", changed.bodies), changed
        )
        robots = ", ".join(sorted({one.robot for one in found}))
        say(f"{write}: has the pivot of {robots}; replay with --rig {write}")
    for one in found if estimates else ():
        state = "has it already" if one.is_stored else f"written to {written}"
        say(f"run {one.record.run} {state}")


def _read_options(given: dict[str, Any]) -> Any:
    from ipsys_log.exchange.import_truth import check_choices
    from ipsys_log.exchange.trajectory_columns import GivenUnits
    from ipsys_log.exchange.trajectory_tables import parse_offset, parse_pivot
    from ipsys_log.statistics.trajectories import KnownParts
    from ipsys_log.tools.estimates import CompareOptions

    units = GivenUnits(given["time_unit"], given["length_unit"])
    check_choices(given["align"], units)
    offset, pivot = given["time_offset"], given["pivot"]
    known = KnownParts(
        None if offset is None else parse_offset(offset),
        given["align"],
        None if pivot is None else parse_pivot(pivot),
        given["scale"],
    )
    return CompareOptions(tuple(given["robot"] or ()), given["run"], known, given["topic"], units)
