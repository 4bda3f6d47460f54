"""Setup of a lab: ``ipsys setup`` on a page, ``ipsys init`` and ``ipsys simulate``."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.cli.console import console, progress_bar, say
from ipsys_log.cli.measure_live import say_faults
from ipsys_log.cli.options import Host, NewLog, OtherLog, Port, other_log_option
from ipsys_log.cli.signals import allow_interrupt, runs_until_stopped, say_kept, stop_on_signal
from ipsys_log.plain_text import HIDDEN, shell_words

if TYPE_CHECKING:
    from ipsys_log.log.location import LogLocation

# The settings of the simulated lab that have an option: default, help. The defaults equal those of the
# library, and a test checks this; importing the library only for a help text is too slow.
SETTINGS: dict[str, tuple[int | float, str]] = {
    "seed": (0, "Seed of the random numbers. The same seed gives the same bytes."),
    "width": (1920, "Width of a frame, in px. The focal length scales with it."),
    "height": (1080, "Height of a frame, in px."),
    "markers": (3, "Number of markers on the floor at the same time."),
    "stations": (50, "Approximate number of calibration points that each camera sees."),
    "frames_per_station": (5, "Frames of each camera in a stationary interval."),
    "rate_hz": (30.0, "Frames per second."),
    "row_time_ns": (0, "Rolling shutter: time between the exposures of two rows, in ns; 31000 is typical."),
    "exposure_s": (0.0, "Motion blur: exposure time of each row, in s; 0.0167 is typical."),
    "drive_s": (15.0, "Driving time of the robots after the calibration points, in s."),
    "drive_speed_m_s": (0.5, "Speed of the robots, in m/s."),
    "psf_sigma_px": (0.7, "Blur of the optics: sigma of the point spread function, in px."),
    "black": (35.0, "Grey level of black on a marker, 0 to 255."),
    "white": (205.0, "Grey level of white on a marker, 0 to 255."),
    "noise_sigma": (2.0, "Sensor noise (standard deviation), in grey levels."),
    "gamma": (1.0, "Gamma of the cameras; 1 is linear."),
    "jpeg_quality": (90, "JPEG quality of the frames, 1 to 100."),
    "mount_height_m": (2.1, "Height of the cameras above the floor, in m."),
    "marker_length_m": (0.2, "Side of a marker's black square, in m."),
    "tape_sigma_m": (0.003, "Standard deviation of the tape readings, in m."),
}

_Grid = Annotated[
    str | None,
    typer.Option(
        metavar="GRID",
        help="Columns x rows of the cameras of a hall, such as 6x4; otherwise, the lab has three cameras.",
    ),
]
_PORT = 8000

_Folder = Annotated[
    Path,
    typer.Argument(metavar="FOLDER", help="The folder of the lab: it gets lab.toml, intrinsics and logs."),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(setup)
    app.command()(init)
    app.command("simulate", help=simulate.__doc__)(_simulate_command())


def init(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="The rig file to write.")] = Path("lab.toml"),
    log: Annotated[
        OtherLog,
        other_log_option("--from", help="Write the rig of a log, a file or a URL, with its camera settings."),
    ] = None,
    simulated: Annotated[
        bool,
        typer.Option(
            "--simulated",
            help="Write the rig of the simulated lab, to try all commands without a camera, and a sheet of "
            "its tape measurements.",
        ),
    ] = False,
) -> None:
    """Write a rig file to edit: markers, cameras, reference points, floor. With comments, or from a log."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.exchange.lab_files import write_new
    from ipsys_log.rig.file import example_toml

    if simulated:
        if log is not None:
            raise IpsysError("--from and --simulated cannot be used together; give one of them")
        _init_simulated(path)
        return
    text = example_toml() if log is None else _rig_of(log)
    write_new({path: text})
    console.print(f"{path} written: edit it to describe your lab")
    if HIDDEN in text:
        console.print(f"a log has no passwords: in each source, replace {HIDDEN} by its password")


def _init_simulated(path: Path) -> None:
    from ipsys_log.exchange.lab_files import simulated_lab_texts, tape_sheet_path, write_new

    texts = simulated_lab_texts(path)
    write_new(texts)
    tape = tape_sheet_path(path)
    lines = texts[tape].splitlines()
    console.print(f"{path} written: the simulated lab, with three cameras")
    console.print(f"{tape} written: the tape measurements of its {len(lines) - 1} stationary markers")
    console.print(f"next: ipsys align --rig {shell_words(path)}")


def _rig_of(log: LogLocation) -> str:
    from ipsys_log.log.dataset import Session
    from ipsys_log.rig.file import rig_toml
    from ipsys_log.runs.select import rig_with_offsets

    with Session([log]) as session:
        # A log opens no socket: its streams are left out.
        return rig_toml(replace(rig_with_offsets(session), stream=None))


def simulate(output: Path, cameras: str | None, **settings: Any) -> None:
    """Render a simulated lab with ground truth: calibration points, then a drive of the robots.

    The default is the lab of the paper: three cameras about 2.1 m above a floor of 4.88 m. With --cameras
    6x4, it is a hall: 24 cameras, 5 m above a floor of 20 x 15 m."""
    from ipsys_log.runs.output import write_log
    from ipsys_log.simulation.lab import simulate
    from ipsys_log.simulation.settings import LabSettings, hall_settings, parse_grid

    lab = LabSettings(**settings) if cameras is None else hall_settings(*parse_grid(cameras), **settings)
    text = f"{output} was not written: the log of a simulated lab is written completely or not at all"
    with say_kept(lambda _: text), progress_bar(frame_steps=("simulate",)) as progress:
        counts = write_log(output, simulate(lab, progress))
    frames = sum(count for topic, count in counts.items() if topic.endswith("/image"))
    console.print(f"{output} written: {frames} frames, {counts.get('/measurements', 0)} calibration points")


@runs_until_stopped
def setup(folder: _Folder, host: Host = None, port: Port = _PORT) -> None:
    """Set a lab up on a page, step by step: rig, cameras, intrinsics, points, fit, and the live view.

    Each step does what its command does, and names it. The state comes from the files of FOLDER: you can
    leave at any time, continue later, and use the commands in between. Ctrl-C ends the page."""
    allow_interrupt("stopped; every finished step is in the folder")
    from ipsys_log.errors import IpsysError
    from ipsys_log.extras import check_installed
    from ipsys_log.report.files import check_folder

    check_installed("setup needs", "starlette", "uvicorn")
    check_folder(folder, "FOLDER")
    from ipsys_log.first_day.lab_folder import LabFolder
    from ipsys_log.web.first_day.app import SetupApp
    from ipsys_log.web.server import check_port_free, qr_code, serve_app

    check_port_free(host, port)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IpsysError(f"{folder}: cannot be made: {error.strerror}") from error
    page = SetupApp(LabFolder(folder))
    signals: list[None] = []  # a list: an Event takes a lock that the interrupted thread may hold
    with serve_app(page.app, host, port, has_viewers=True) as server:
        stop_on_signal(lambda: signals.append(None))
        if host is not None:
            console.print(qr_code(server.url), style="#ffffff on #000000")
        console.print(f"open {server.url}")
        if server.view_url is not None:
            say(f"to view only: {server.view_url}")
        say(f"Ctrl-C ends; to continue: {_command(folder, host, port)}")
        try:
            server.wait(lambda: bool(signals))
        finally:
            page.session.close()
            say_faults(server, "the setup page")
            for bug in page.session.jobs.bugs:
                say(bug)
    if page.session.jobs.bugs:
        raise typer.Exit(1)


def _simulate_command() -> Callable[..., None]:
    """Build the command of :func:`simulate` with an option for each setting."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    parameters = [
        inspect.Parameter("context", keyword, annotation=typer.Context),
        inspect.Parameter("output", keyword, annotation=NewLog),
        inspect.Parameter("cameras", keyword, default=None, annotation=_Grid),
    ]
    for name, (default, text) in SETTINGS.items():
        annotation = Annotated[type(default), typer.Option(help=text)]  # type: ignore[valid-type]
        parameters.append(inspect.Parameter(name, keyword, default=default, annotation=annotation))

    def command(context: typer.Context, **given: Any) -> None:
        # A hall has other defaults than the lab of the paper, so only options of the user count.
        chosen = {name: given[name] for name in SETTINGS if _is_chosen(context, name)}
        simulate(given["output"], given["cameras"], **chosen)

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    return command


def _is_chosen(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


def _command(folder: Path, host: str | None, port: int) -> str:
    """Return the command that continues with the same options."""
    options = [] if host is None else ["--host", host]
    options += [] if port == _PORT else ["--port", str(port)]
    return shlex.join(["ipsys", "setup", str(folder), *options])
