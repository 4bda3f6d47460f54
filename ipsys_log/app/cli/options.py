"""Options that several commands share, and the check of their values: logs, URLs, and names of files."""

from __future__ import annotations

import functools
import inspect
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.app.cli.console import say
from ipsys_log.stages import CORNERS, METHOD, StageParameter

if TYPE_CHECKING:
    from ipsys_log.log.location import LogLocation

    LogList = list[LogLocation]
    OneLog = LogLocation
    OtherLog = LogLocation | None
    NoLogs = LogList | None
else:
    LogList = list[str]  # typer knows no union of types
    OneLog = str
    OtherLog = str | None
    NoLogs = list[str] | None


# A path has lost one of the two slashes of a URL.
_URL_AS_PATH = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")

Paths = list[Path] | Path | None


def is_url(path: Path) -> bool:
    """Return whether a path is a URL, and no file of such a name."""
    return _URL_AS_PATH.match(str(path)) is not None and not path.exists()


def read_files(given: Paths) -> Paths:
    """Return the file, or the files, of an argument of a command that reads only files.

    Raises
    ------
    IpsysError
        A URL is among them.
    """
    _refuse(given, "is at a URL, but this command reads files; download them first")
    return given


def appended_logs(given: Paths) -> Paths:
    """Return the log, or the logs, that a command extends or repairs.

    Raises
    ------
    IpsysError
        A URL is among them.
    """
    _refuse(given, "is at a URL, but this command writes into the log; download the log first")
    return given


def needs_local_files(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command: it refuses a URL as the value of each parameter that is a path."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> Any:
        for name, value in options.items():
            option = "-o " if name == "output" else ""
            _refuse(value, "is a URL; name a file or a folder on this machine", option)
        return command(*arguments, **options)

    return run


def _refuse(given: object, why: str, option: str = "") -> None:
    for path in given if isinstance(given, list) else [given]:
        if isinstance(path, Path) and is_url(path):
            from ipsys_log.errors import IpsysError
            from ipsys_log.log.location import LogUrl

            url = LogUrl(str(path).replace(":/", "://", 1))
            raise IpsysError(f"{option}{url}: {why}")


# An option of a command that a table makes: its type with its help, and its default.
Option = tuple[Any, Any]
REQUIRED = inspect.Parameter.empty


def option(
    kind: Any, name: str, metavar: str | None, text: str, default: Any = None, **settings: Any
) -> Option:
    """Return an option; other names follow the first one after a comma."""
    names = name.split(",")
    return Annotated[kind, typer.Option(*names, metavar=metavar, help=text, **settings)], default


def flag(name: str, text: str, **settings: Any) -> Option:
    """Return an option without a value."""
    return option(bool, name, None, text, False, **settings)


def stage_option(parameter: StageParameter) -> Option:
    """Return the option of a parameter of a stage."""
    name = f"--{parameter.name.replace('_', '-')}"
    least = {"min": parameter.least} if parameter.least is not None else {}
    return option(parameter.kind, name, parameter.metavar, parameter.help, parameter.default, **least)


def with_options(options: Mapping[str, Option]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of a table, by the names of its parameters."""
    keyword = inspect.Parameter.KEYWORD_ONLY

    def decorate(work: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(work)
        def command(**given: Any) -> None:
            work(**given)

        parameters = [
            inspect.Parameter(name, keyword, default=default, annotation=kind)
            for name, (kind, default) in options.items()
        ]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {name: kind for name, (kind, _) in options.items()}
        return command

    return decorate


def _locations(texts: list[str] | None) -> list[Any]:
    """Return the logs of an argument; a pattern of a URL gives all its objects."""
    from ipsys_log.log.log_files import find_logs

    return find_logs(texts or ())


def _location(text: str | None) -> Any:
    """Return the log of an option, a file or a URL."""
    from ipsys_log.log.location import parse_location

    return None if text is None else parse_location(text)


log_argument = partial(typer.Argument, metavar="LOG", callback=_locations)
one_log_argument = partial(typer.Argument, metavar="LOG", callback=_location)
other_log_option = partial(typer.Option, metavar="LOG", callback=_location)
file_log_argument = partial(typer.Argument, metavar="LOG", callback=read_files)
appended_log_argument = partial(typer.Argument, metavar="LOG", callback=appended_logs)
appended_log_option = partial(typer.Option, metavar="LOG", callback=appended_logs)
Logs = Annotated[
    LogList, log_argument(help="Logs, files or URLs, read as one. The last log gets the results.")
]
ReadLogs = Annotated[LogList, log_argument(help="Logs, files or URLs, read as one session.")]

# File name extensions of other input and output files: a log with such a name is a mistake.
_OTHER_FILES = (
    *(".html", ".htm", ".csv", ".json", ".toml", ".yaml", ".yml", ".rrd"),
    *(".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp"),
)


def check_present(logs: Sequence[LogLocation]) -> None:
    """Check that the files of logs exist, before the imports of the pipeline, which take longer.

    Raises
    ------
    LogError
        A log is missing.
    """
    for log in logs:
        if isinstance(log, Path) and not log.exists():
            from ipsys_log.log.byte_source import open_for_reading

            os.close(open_for_reading(log))


def _named_as_log(path: Path | None) -> Path | None:
    """Return the path of a new log, with the extension of logs.

    Raises
    ------
    IpsysError
        The name is that of another kind of file.
    """
    if path is None or path.suffix == ".mcap" or path.is_dir() or is_url(path):
        return path
    if path.suffix.lower() in _OTHER_FILES:
        from ipsys_log.errors import IpsysError

        page = "; ipsys report --html FILE writes a page" if path.suffix.lower() in (".html", ".htm") else ""
        raise IpsysError(f"-o {path}: the name of a new log ends in .mcap{page}")
    named = path.with_name(f"{path.name}.mcap")
    say(f"-o {path}: the log gets the name {named}")
    return named


def figure_option(subject: str) -> Any:
    """Return the option for the file of a figure, which is checked by `report.files.check_figure_file`."""
    return typer.Option("--plot", metavar="FILE", help=f"Draw {subject}: .png, .pdf, .svg or .jpg.")


# The options that every command uses for the name of a new log.
log_option = partial(typer.Option, "--output", "-o", metavar="LOG", callback=_named_as_log)
NewLog = Annotated[Path, log_option(help="The log to write, with a name that ends in .mcap.")]
RigFile = Annotated[
    Path | None,
    typer.Option("--rig", metavar="FILE", help="Use this rig file (lab.toml) instead of the rig in the log."),
]
Calibrations = Annotated[
    list[str] | None,
    typer.Option(
        "--calibration",
        metavar="CAMERA=FILE",
        help="Use these camera intrinsics: a calibration file of OpenCV, ROS, Kalibr or others, or a "
        "log with them. Repeat it for each camera; a log without CAMERA= gives the intrinsics of all.",
    ),
]
Corners = stage_option(CORNERS)[0]
Method = stage_option(METHOD)[0]
Only = Annotated[
    list[str] | None,
    typer.Option("--camera", metavar="NAME", help="Use only this camera of the rig; repeat it for several."),
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite an existing log of this name.")]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", "--force", help="Replace an existing log of this name.")
]
Host = Annotated[
    str | None,
    typer.Option(
        "--host",
        metavar="ADDRESS",
        help="Let a phone in this network open the page: 0.0.0.0 for all addresses of this machine, or "
        "one address. The page has a new secret at each start. Default: only this machine.",
    ),
]
Port = Annotated[
    int,
    typer.Option(min=0, max=65535, metavar="PORT", help="Port of the page; 0 for any free port."),
]
RigNow = Annotated[
    Path, typer.Option("--rig", metavar="FILE", help="The rig file, with a source for each camera.")
]
Terminal = Annotated[
    bool, typer.Option("--terminal", help="Ask for the measurements in the terminal instead of on a page.")
]
FittedModels = Annotated[
    list[str] | None,
    typer.Option(
        "--model",
        metavar="NAME",
        help="Model of this log, such as best; repeat it for several. The first one is shown, streamed and "
        "used by robots. Default: poly, if the log has it.",
    ),
]
Seconds = Annotated[float | None, typer.Option(min=0.1, metavar="SECONDS", help="Stop after this time.")]
Train = Annotated[str, typer.Option(metavar="LABEL", help="Fit on the measurements with this label.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
