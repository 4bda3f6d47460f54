"""Views of a log in other programs: ``ipsys view``, ``report`` and ``export``."""

import json
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from ipsys_log.app.cli.console import console, progress_bar, remarks, say
from ipsys_log.app.cli.options import ReadLogs, setting, switch, with_options
from ipsys_log.app.cli.stages import derive, options_until
from ipsys_log.app.report.files import FIGURE_SUFFIXES, check_figure_file, check_file, write_files
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogLocation, file_beside
from ipsys_log.plain_text import shell_words

_COUNTED = ("bag", "video", "pictures")
Runs = Annotated[
    list[str] | None, setting("--run", "NAME", "Show this run instead of the newest; repeat it for several.")
]
Save = Annotated[
    Path | None,
    setting(
        "--save,-o",
        "FILE",
        "Write a Rerun recording (.rrd), or a picture of the floor with the tracks (.png, .pdf, .svg or "
        ".jpg), instead of opening the viewer.",
    ),
]
FoxgloveLayout = Annotated[
    Path | None,
    setting(
        "--foxglove-layout",
        "FILE",
        "Write a layout of Foxglove for the log (.json) instead of opening the viewer.",
    ),
]
_HTML = (
    Annotated[
        Path | None, setting("--html", "FILE", "The page to write. Default: the log's name with .html.")
    ],
    None,
)
_REPORT = """
Write an HTML page on a session: its accuracy, its recording and its runs.

The page needs no network. Without calibration points, it has no accuracy. For a log of ipsys drive, it has
the errors of the robots, and figure 12 of the paper.

Without options of stages, the page shows the evaluations in the log; ipsys evaluate adds more. A log that has
none gets those of all models first; on a terminal, the command asks before.

Examples

    ipsys report calibration.mcap                      # calibration.html
    ipsys report calibration.mcap --model poly --model best
"""


def view(logs: ReadLogs, run: Runs = None, save: Save = None, foxglove_layout: FoxgloveLayout = None) -> None:
    """Show frames with drawn markers, floor, calibration points, positions and tracks over time, in Rerun.

    Examples

        ipsys view monday.mcap                             # the newest run
        ipsys view monday.mcap --run poly -o monday.rrd
        ipsys view monday.mcap -o floor.png
    """
    from ipsys_log.log.dataset import Session

    if foxglove_layout is not None:
        _write_layout(logs, run or (), foxglove_layout)
        if save is None:
            return
    if save is not None:
        if save.suffix.lower() in FIGURE_SUFFIXES:
            _draw_floor(logs, run or (), save)
            return
        if save.suffix != ".rrd":  # Rerun opens a recording by its name
            raise IpsysError(
                f"--save {save}: use {save.stem}.rrd for a Rerun recording, or {save.stem}.png for a picture"
            )
        check_file(save, "--save", logs)
    check_installed("view needs", "rerun")
    from ipsys_log.engine.states import out_of_date_lines
    from ipsys_log.sinks.rerun.recording import write_recording

    with Session(logs) as session:
        shown = write_recording(session, run or (), save)
        for line in out_of_date_lines(session, [shown.markers, *shown.runs]):
            say(line)
    for kind, names in (("markers", [shown.markers]), ("positions and tracks", shown.runs)):
        named = ", ".join(name for name in names if name)
        if named:
            say(f"{kind:<21} run {named}")
    if save is not None:
        say(f"{save} written; to view it: rerun {save}")


def _draw_floor(logs: Sequence[LogLocation], runs: Sequence[str], path: Path) -> None:
    check_figure_file(path, "--save")
    from ipsys_log.app.report.accuracy import Accuracy
    from ipsys_log.app.report.floor_figure import draw_session
    from ipsys_log.log.dataset import Session
    from ipsys_log.sinks.selection import choose_runs

    with Session(logs) as session:
        shown = choose_runs(session, runs).runs
        draw_session(session, [Accuracy(run, None, None) for run in shown], path)
    say(f"{path} drawn")


def _write_layout(logs: Sequence[LogLocation], runs: Sequence[str], path: Path) -> None:
    from ipsys_log.log.atomic_files import replacement_of
    from ipsys_log.log.dataset import Session
    from ipsys_log.sinks.foxglove_layout import make_layout

    if path.suffix != ".json":
        raise IpsysError(f"--foxglove-layout {path}: a layout ends in .json; use {path.stem}.json")
    check_file(path, "--foxglove-layout", logs)
    with Session(logs) as session:
        layout = make_layout(session, runs)
    with replacement_of(path) as file:
        file.write(json.dumps(layout, indent=2).encode() + b"\n")
    say(f"{path} written; in Foxglove: Layouts, Import from file")


def _report(logs: Sequence[LogLocation], output: Path | None, html: Path | None, **given: Any) -> None:
    check_installed("report needs", "matplotlib", "jinja2")
    from ipsys_log.app.report.accuracy import read_accuracy
    from ipsys_log.app.report.html import render_report
    from ipsys_log.app.report.robot_run import render_robot_run
    from ipsys_log.engine.states import newest_evaluations
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import MEASUREMENTS
    from ipsys_log.tools.robot_run import has_robot_run

    target = html or file_beside(output or logs[-1], ".html")
    check_file(target, "--html", [*logs, *([output] if output else [])])
    with Session(logs) as session:
        if has_robot_run(session):
            picture = target.with_suffix(".png")
            check_file(picture, "--html", logs)
            page, panels = render_robot_run(session)
            write_files(target.parent, {target.name: page.encode(), picture.name: panels})
            console.print(f"{target} and {picture} written")
            return
        has_points = bool(session.topics(MEASUREMENTS))
        asked = any(given[name] and given[name] != default for name, (_, default) in _DERIVED.items())
        evaluated = [] if asked else newest_evaluations(session)
        is_old = any(one.out_of_date for one in evaluated)
        computes = has_points and (is_old or not evaluated)
        if computes and not asked:
            computes = _may_evaluate([one.method for one in evaluated])
            if not (computes or evaluated):
                say(f"no page was written; with one model: ipsys report {shell_words(*logs)} --model poly")
                return
        if computes and is_old:  # these models again, and no others
            given["model"], evaluated = [one.method for one in evaluated], []
        if not computes:
            page = render_report(session, read_accuracy(session, [one.run for one in evaluated]))
    if computes:
        with derive(logs, "evaluate", output, again="use ipsys evaluate", **given) as (
            session,
            _,
            accuracies,
        ):
            page = render_report(session, accuracies)
    write_files(target.parent, {target.name: page.encode()})
    console.print(f"{target} written: open it in a browser")
    if not has_points:
        say("the session has no calibration points: the page shows the recording and its runs")
    elif evaluated:
        say(f"evaluated before: {', '.join(one.method for one in evaluated)}; to add models: ipsys evaluate")


def _may_evaluate(out_of_date: Sequence[str]) -> bool:
    """Ask on a terminal whether to evaluate models, which can take minutes; elsewhere return True."""
    if not (sys.stdin.isatty() and remarks.is_terminal):
        return True
    from ipsys_log.app.cli.dialog import LetterError, agreed

    text = "no model is evaluated yet. Evaluate all models now?"
    if out_of_date:
        text = f"out of date: {', '.join(out_of_date)}. Evaluate these models again?"
    with suppress(LetterError):
        return agreed(f"{text} This can take minutes.", True)
    return False


_options = options_until("evaluate")
del _options["as_json"]
# The options with which the command computes what they ask for.
_DERIVED = {name: option for name, option in _options.items() if name not in ("logs", "output", "jobs")}
report = with_options({**_options, "html": _HTML}, "report", _REPORT)(_report)


def export(
    logs: ReadLogs,
    output: Annotated[
        Path | None,
        setting(
            "--output,-o",
            "FILE",
            "The file to write. Its suffix gives the format: .csv, .parquet (tables), .tum, .kitti "
            "(trajectories), .mcap (ROS 2 bag), .mp4 (video). For --format coco: a new folder.",
        ),
    ] = None,
    format_: Annotated[
        str | None,
        setting(
            "--format",
            "NAME",
            "csv, parquet, tum, kitti, ros2, mp4 or coco. Default: by the name of the file.",
        ),
    ] = None,
    table: Annotated[
        str,
        setting(
            "--table",
            "NAME",
            "tracks, positions, markers, camera_points, pairs, measurements, events, latency, truth "
            "or estimate.",
        ),
    ] = "tracks",
    run: Annotated[
        list[str] | None,
        setting("--run", "NAME", "Export this run instead of the newest; repeat it for several."),
    ] = None,
    robot: Annotated[str | None, setting("--robot", "NAME", "Export only this robot.")] = None,
    trim: Annotated[
        bool,
        switch("--trim", "Write a trajectory and its ground truth (FILE_truth), both at the same instants."),
    ] = False,
    without_images: Annotated[
        bool, switch("--without-images", "Leave the images out of a ROS 2 bag.")
    ] = False,
    frame_rate: Annotated[float, setting("--frame-rate", "HZ", "Frames per second of a video.")] = 25.0,
    size: Annotated[
        str, setting("--size", "WIDTHxHEIGHT", "Size of a video in pixels, two even numbers.")
    ] = "1280x720",
) -> None:
    """Export positions, images or another channel to a file for other programs.

    A table has one row for each robot and instant; units are in the names of the columns, times are in UTC. A
    ROS 2 bag has images, intrinsics, poses, odometry and transforms. A video shows the cameras with their
    markers, and the robots on the floor. A COCO data set has the images and the corners of their markers.

    Examples

        ipsys export monday.mcap -o tracks.csv
        ipsys export monday.mcap -o tracks.parquet --run poly --run best
        ipsys export monday.mcap -o robot.tum --robot robot_0    # for evo
        ipsys export monday.mcap -o r.tum --robot robot_0 --trim   # for evo_ape
        ipsys export monday.mcap -o bag.mcap --format ros2       # with images
        ipsys export monday.mcap -o view.mp4 --size 1920x1080
        ipsys export monday.mcap -o markers --format coco        # a new folder
    """
    from ipsys_log.api import python_api as api
    from ipsys_log.api.log_export import EXPORT_FORMATS, find_format, parse_size

    if output is None:
        formats = [f"-o NAME{row.suffix} ({row.text})" for row in EXPORT_FORMATS.values() if row.suffix]
        raise IpsysError(f"-o is missing; use {', '.join(formats)}, or --format coco -o FOLDER")
    wanted = find_format(output, format_)
    if wanted.suffix is not None:
        check_file(output, "-o", logs)
    with api.open(*logs) as log, progress_bar(_COUNTED) as progress:
        exported = log.export(
            output,
            table,
            run,
            robot,
            format=format_,
            with_images=not without_images,
            rate_hz=frame_rate,
            size_px=parse_size(size),
            trim=trim,
            progress=progress,
        )
    console.print(
        f"{output} written: {exported.rows} {exported.content}"
        + (f", run {' and '.join(exported.runs)}" if exported.runs else "")
    )
