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
from ipsys_log.app.report.files import check_figure_file, check_figures
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation, LogUrl, parse_location
from ipsys_log.stages import CORNERS, METHOD, SELF_CALIBRATE, StageParameter

if TYPE_CHECKING:
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
_NOT_HERE = "is a URL; name a file or a folder on this machine"


def is_url(path: Path) -> bool:
    """Return whether a path is a URL, and no file of such a name."""
    return _URL_AS_PATH.match(str(path)) is not None and not path.exists()


def refuse_urls(why: str) -> Callable[[Paths], Paths]:
    """Return a function that checks the files of an argument, and refuses a URL with a reason."""

    def check(given: Paths) -> Paths:
        _refuse(given, why)
        return given

    return check


read_files = refuse_urls("is at a URL, but this command reads files; download them first")
_appended = refuse_urls("is at a URL, but this command writes into the log; download the log first")


def needs_local_files(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command: it refuses a URL as the value of each parameter that is a path."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> Any:
        for name, value in options.items():
            option = "-o " if name == "output" else ""
            _refuse(value, _NOT_HERE, option)
        return command(*arguments, **options)

    return run


def _refuse(given: object, why: str, option: str = "") -> None:
    for path in given if isinstance(given, list) else [given]:
        if isinstance(path, Path) and is_url(path):
            url = LogUrl(str(path).replace(":/", "://", 1))
            raise IpsysError(f"{option}{url}: {why}")


# An option of a command that a table makes: its type with its help, and its default.
Option = tuple[Any, Any]
REQUIRED = inspect.Parameter.empty


def setting(names: str, metavar: str | None, text: str, **settings: Any) -> Any:
    """Return the description of an option with a value; other names follow the first one after a comma."""
    return typer.Option(*names.split(","), metavar=metavar, help=text, **settings)


def switch(names: str, text: str, **settings: Any) -> Any:
    """Return the description of an option without a value."""
    return setting(names, None, text, **settings)


def option(
    kind: Any, names: str, metavar: str | None, text: str, default: Any = None, **settings: Any
) -> Option:
    """Return an option of a table."""
    return Annotated[kind, setting(names, metavar, text, **settings)], default


def flag(name: str, text: str, **settings: Any) -> Option:
    """Return an option without a value."""
    return option(bool, name, None, text, False, **settings)


def stage_option(parameter: StageParameter) -> Option:
    """Return the option of a parameter of a stage."""
    name = f"--{parameter.name.replace('_', '-')}"
    least = {"min": parameter.least} if parameter.least is not None else {}
    return option(parameter.kind, name, parameter.metavar, parameter.help, parameter.default, **least)


def with_options(
    options: Mapping[str, Option], name: str | None = None, text: str | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of a table, by the names of its parameters; and a name and a help text."""
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
        if name is not None:
            command.__name__, command.__doc__ = name, text
        return command

    return decorate


def _locations(texts: list[str] | None) -> list[Any]:
    """Return the logs of an argument; a pattern of a URL gives all its objects."""
    from ipsys_log.log.log_files import find_logs

    return find_logs(texts or ())


def _location(text: str | None) -> Any:
    """Return the log of an option, a file or a URL."""
    return None if text is None else parse_location(text)


log_argument = partial(typer.Argument, metavar="LOG", callback=_locations)
other_log_option = partial(typer.Option, metavar="LOG", callback=_location)
file_log_argument = partial(typer.Argument, metavar="LOG", callback=read_files)
appended_log_argument = partial(typer.Argument, metavar="LOG", callback=_appended)
appended_log_option = partial(typer.Option, metavar="LOG", callback=_appended)
Logs = Annotated[
    LogList, log_argument(help="Logs, files or URLs, read as one. The last log gets the results.")
]
ReadLogs = Annotated[LogList, log_argument(help="Logs, files or URLs, read as one session.")]

# File name extensions of other input and output files: a log with such a name is a mistake.
_OTHER_FILES = (
    *(".html", ".htm", ".csv", ".json", ".toml", ".yaml", ".yml", ".rrd"),
    *(".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp"),
)


# A message about a missing log names at most so many others.
_NAMED_LOGS = 5


def check_present(logs: Sequence[LogLocation]) -> None:
    """Check that the files of logs exist, before the imports of the pipeline, which take longer."""
    for log in logs:
        if isinstance(log, Path) and not log.exists():
            from ipsys_log.log.byte_source import open_for_reading

            try:
                os.close(open_for_reading(log))
            except IpsysError as error:
                if log.is_symlink():
                    raise
                beside = ", ".join(sorted(one.name for one in log.parent.glob("*.mcap"))[:_NAMED_LOGS])
                raise IpsysError(f"{error}; the logs in this folder: {beside or 'none'}") from None


def _named_as_log(path: Path | None) -> Path | None:
    """Return the path of a new log, with the extension of logs; other extensions are errors."""
    if path is None or path.suffix == ".mcap" or path.is_dir() or is_url(path):
        return path
    if path.suffix.lower() in _OTHER_FILES:
        page = "; ipsys report --html FILE writes a page" if path.suffix.lower() in (".html", ".htm") else ""
        raise IpsysError(f"-o {path}: the name of a new log ends in .mcap{page}")
    named = path.with_name(f"{path.name}.mcap")
    say(f"-o {path}: the log gets the name {named}")
    return named


def _figure_file(path: Path | None) -> Path | None:
    """Return the file of a figure, after the check that it can be written in its format."""
    _refuse(path, _NOT_HERE)
    if path is not None:
        check_figure_file(path, "--plot")
    return path


def _figure_files(paths: list[Path] | None) -> list[Path] | None:
    """Return the files of figures, and the folders of all figures, after the same check."""
    _refuse(paths, _NOT_HERE)
    for path in paths or ():
        check_figures(path, "--plot")
    return paths


def figure_option(subject: str, folder: str | None = None) -> Any:
    """Return the description of the option ``--plot``; ``folder`` names the figures that a folder gets."""
    text = f"Draw {subject}: .png, .pdf, .svg or .jpg."
    if folder is None:
        return setting("--plot", "FILE", text, callback=_figure_file)
    text += f" DIR or 'DIR/*.svg': {folder}. Repeat it for several."
    return setting("--plot", "FILE|DIR", text, callback=_figure_files)


# The options that every command uses for the name of a new log.
log_option = partial(typer.Option, "--output", "-o", metavar="LOG", callback=_named_as_log)
NewLog = Annotated[Path, log_option(help="The log to write, with a name that ends in .mcap.")]
RigFile = Annotated[
    Path | None, setting("--rig", "FILE", "Use this rig file (lab.toml) instead of the rig in the log.")
]
Calibrations = Annotated[
    list[str] | None,
    setting(
        "--calibration",
        "CAMERA=FILE",
        "Use these camera intrinsics: a calibration file of OpenCV, ROS, Kalibr or others, or a "
        "log with them. Repeat it for each camera; a log without CAMERA= gives the intrinsics of all.",
    ),
]
Corners = stage_option(CORNERS)[0]
Method = stage_option(METHOD)[0]
SelfCalibrate = stage_option(SELF_CALIBRATE)[0]
Only = Annotated[
    list[str] | None, setting("--camera", "NAME", "Use only this camera of the rig; repeat it for several.")
]
Force = Annotated[bool, switch("--force", "Overwrite an existing log of this name.")]
Overwrite = Annotated[bool, switch("--overwrite,--force", "Replace an existing log of this name.")]
Host = Annotated[
    str | None,
    setting(
        "--host",
        "ADDRESS",
        "Let a phone in this network open the page: 0.0.0.0 for all addresses of this machine, or "
        "one address. The page has a new secret at each start. Default: only this machine.",
    ),
]
Port = Annotated[int, setting("--port", "PORT", "Port of the page; 0 for any free port.", min=0, max=65535)]
RigNow = Annotated[Path, setting("--rig", "FILE", "The rig file, with a source for each camera.")]
Terminal = Annotated[
    bool, switch("--terminal", "Ask for the measurements in the terminal instead of on a page.")
]
FittedModels = Annotated[
    list[str] | None,
    setting(
        "--model",
        "NAME",
        "Model of this log, such as best; repeat it for several. The first one is shown, streamed and "
        "used by robots. Default: poly, if the log has it.",
    ),
]
Seconds = Annotated[float | None, setting("--seconds", "SECONDS", "Stop after this time.", min=0.1)]
Train = Annotated[str, setting("--train", "LABEL", "Fit on the measurements with this label.")]
AsJson = Annotated[bool, switch("--json", "Print JSON.")]
