"""Commands that show or repair a log: ``ipsys info``, ``runs``, ``view``, ``report`` and ``repair``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from ipsys_log.cli.console import console, print_outcomes, progress_bar, remarks, say
from ipsys_log.cli.options import AsJson, ReadLogs, appended_log_argument
from ipsys_log.cli.signals import writes_nothing
from ipsys_log.cli.stages import MORE, build_command, derive, options_until

if TYPE_CHECKING:
    from ipsys_log.log.location import LogLocation

Runs = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--run", metavar="NAME", help="Show this run instead of the newest; repeat it for several."),
]
Save = Annotated[
    Path | None,
    typer.Option(
        "--save", metavar="FILE", help="Write a Rerun recording (.rrd) instead of opening the viewer."
    ),
]
FoxgloveLayout = Annotated[
    Path | None,
    typer.Option(
        "--foxglove-layout",
        metavar="FILE",
        help="Write a layout of Foxglove for the log (.json) instead of opening the viewer.",
    ),
]
_HTML = (
    Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--html", metavar="FILE", help="The page to write. Default: the log's name with .html."),
    ],
    None,
)
_HELP = (
    "Write an HTML page on a session: its accuracy, its recording and its runs.\n\n"
    "The page needs no network. Without calibration points, it has no accuracy. For a log of ipsys drive, "
    f"it has the errors of the robots, and figure 12 of the paper.{MORE}"
)


def add_commands(app: typer.Typer) -> None:
    app.command()(info)
    app.command()(runs)
    app.command()(repair)
    app.command()(view)
    options = options_until("evaluate")
    del options["as_json"]
    app.command("report", help=_HELP)(build_command({**options, "html": _HTML}, _report))


@writes_nothing
def info(logs: ReadLogs, as_json: AsJson = False) -> None:
    """Show cameras, channels, counts, rates, gaps and runs of a log."""
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.contents import contents_json, contents_tables

    with Session(logs) as session:
        contents = contents_json(session)
    if as_json:
        print(json.dumps(contents, indent=2))  # noqa: T201
    else:
        for number, table in enumerate(contents_tables(contents)):
            if number:
                console.print()
            console.print(table)


@writes_nothing
def runs(logs: ReadLogs, as_json: AsJson = False) -> None:
    """Show the runs of a log: stage, inputs, parameters, version of ipsys, and state.

    A run is current, out of date, not repeatable or unfinished. If it is out of date, the reason follows, and
    ipsys replay makes a new run. Inputs of a run that is not repeatable are not in the log. The writer of an
    unfinished run was stopped.
    """
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.contents import runs_table, states_json

    with Session(logs) as session:
        states = states_json(session)
    if as_json:
        print(json.dumps(states, indent=2))  # noqa: T201
    else:
        console.print(runs_table(states))


def repair(
    log: Annotated[Path, appended_log_argument(help="A damaged or incomplete log.")],
) -> None:
    """Repair a log: keep everything that can be read, report the losses, and complete its runs.

    A log without an end is completed in place. For any other damage, a new log replaces it. The old data are
    kept in <log>.damaged. A log that cannot be repaired is not changed. If ipsys live
    or record --detect was killed, the command also processes the recorded frames that have no results. For
    this it computes the runs again. After Ctrl-C, ipsys replay can do this instead.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.log.dataset import Session
    from ipsys_log.log.recovery import repair as repair_log
    from ipsys_log.report.repair import repair_lines

    for part in repair_lines(repair_log(log)):
        console.print(part, markup=False)
    try:
        with Session([log]) as session:
            if not session.run_names():
                return  # there is no run to complete, so the stages are not imported
        from ipsys_log.restore import finish_runs

        with progress_bar() as progress:
            print_outcomes(finish_runs(log, progress))
    except IpsysError as error:  # the log itself is complete
        remarks.print(f"unfinished runs cannot be completed: {error}", style="yellow", markup=False)


def view(logs: ReadLogs, run: Runs = None, save: Save = None, foxglove_layout: FoxgloveLayout = None) -> None:
    """Show frames with drawn markers, floor, calibration points, positions and tracks over time, in Rerun."""
    from ipsys_log.extras import check_installed
    from ipsys_log.log.dataset import Session

    if foxglove_layout is not None:
        _write_layout(logs, run or (), foxglove_layout)
        if save is None:
            return
    check_installed("view needs", "rerun")
    if save is not None:
        _check_save(save, logs)
    from ipsys_log.runs.states import out_of_date_lines
    from ipsys_log.sinks.rerun.recording import write_recording

    with Session(logs) as session:
        shown = write_recording(session, run or (), save)
        for line in out_of_date_lines(session, [shown.markers, *shown.runs]):
            say(line)
    for kind, names in (("markers", [shown.markers]), ("positions and tracks", shown.runs)):
        named = ", ".join(name for name in names if name)
        if named:
            remarks.print(f"{kind:<21} run {named}")
    if save is not None:
        remarks.print(f"{save} written; to view it: rerun {save}")


def _write_layout(logs: Sequence[LogLocation], runs: Sequence[str], path: Path) -> None:
    from ipsys_log.atomic_files import replacement_of
    from ipsys_log.errors import IpsysError
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.files import check_file
    from ipsys_log.sinks.foxglove_layout import make_layout

    if path.suffix != ".json":
        raise IpsysError(f"--foxglove-layout {path}: a layout ends in .json; use {path.stem}.json")
    check_file(path, "--foxglove-layout", logs)
    with Session(logs) as session:
        layout = make_layout(session, runs)
    with replacement_of(path) as file:
        file.write(json.dumps(layout, indent=2).encode() + b"\n")
    remarks.print(f"{path} written; in Foxglove: Layouts, Import from file")


def _check_save(save: Path, logs: Sequence[LogLocation]) -> None:
    """Check that a recording can be written, and that Rerun will open it by its name."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.report.files import check_file

    if save.suffix != ".rrd":
        raise IpsysError(f"--save {save}: the name of a Rerun recording ends in .rrd; use {save.stem}.rrd")
    check_file(save, "--save", logs)


def _report(logs: Sequence[LogLocation], output: Path | None, html: Path | None, **given: Any) -> None:
    from ipsys_log.extras import check_installed
    from ipsys_log.report.files import check_file, write_files

    check_installed("report needs", "matplotlib", "jinja2")
    from ipsys_log.log.location import file_beside

    target = html or file_beside(output or logs[-1], ".html")
    check_file(target, "--html", [*logs, *([output] if output else [])])
    if _report_robots(logs, target):
        return
    if _report_recording(logs, target):
        return
    from ipsys_log.report.html import render_report

    with derive(logs, "evaluate", output, **given) as (session, _, accuracies):
        write_files(target.parent, {target.name: render_report(session, accuracies).encode()})
    console.print(f"{target} written: open it in a browser", markup=False)


def _report_recording(logs: Sequence[LogLocation], target: Path) -> bool:
    """Write the page of a session without calibration points; return False if the logs have some."""
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import MEASUREMENTS
    from ipsys_log.report.files import write_files
    from ipsys_log.report.html import render_report

    with Session(logs) as session:
        if session.topics(MEASUREMENTS):
            return False
        page = render_report(session, ())
    write_files(target.parent, {target.name: page.encode()})
    console.print(f"{target} written: open it in a browser", markup=False)
    remarks.print("the session has no calibration points: the page shows the recording and its runs")
    return True


def _report_robots(logs: Sequence[LogLocation], target: Path) -> bool:
    """Write the page and the figure of a robot run; return False if the logs have none."""
    from ipsys_log.analysis.robot_run import has_robot_run
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.files import check_file, write_files
    from ipsys_log.report.robot_run import render_robot_run

    with Session(logs) as session:
        if not has_robot_run(session):
            return False
        picture = target.with_suffix(".png")
        check_file(picture, "--html", logs)
        page, panels = render_robot_run(session)
    write_files(target.parent, {target.name: page.encode(), picture.name: panels})
    console.print(f"{target} and {picture} written", markup=False)
    return True
