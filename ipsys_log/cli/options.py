"""Options that several commands share."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from ipsys_log.cli.console import remarks
from ipsys_log.cli.local_files import appended_logs, is_url, read_files
from ipsys_log.stages import CORNERS, METHOD, StageParameter

if TYPE_CHECKING:
    from ipsys_log.capture.lab import Lab
    from ipsys_log.log.location import LogLocation
    from ipsys_log.messages import CameraCalibration, Rig

    LogList = list[LogLocation]
    OneLog = LogLocation
    OtherLog = LogLocation | None
    NoLogs = LogList | None
else:
    LogList = list[str]  # typer knows no union of types
    OneLog = str
    OtherLog = Optional[str]  # noqa: UP045
    NoLogs = Optional[list[str]]  # noqa: UP045


def build_option(parameter: StageParameter) -> Any:
    """Return the option of a parameter of a stage."""
    return typer.Option(
        f"--{parameter.name.replace('_', '-')}",
        metavar=parameter.metavar,
        min=parameter.least,
        help=parameter.help,
    )


def annotate(parameter: StageParameter) -> Any:
    """Return the annotation of a parameter of a stage: its type with its option."""
    kind = parameter.kind
    return Annotated[kind, build_option(parameter)]


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
    remarks.print(f"-o {path}: the log gets the name {named}", markup=False)
    return named


# The options that every command uses for the name of a new log.
log_option = partial(typer.Option, "--output", "-o", metavar="LOG", callback=_named_as_log)
NewLog = Annotated[Path, log_option(help="The log to write, with a name that ends in .mcap.")]
RigFile = Annotated[
    Path | None,
    typer.Option("--rig", metavar="FILE", help="Use this rig file (lab.toml) instead of the rig in the log."),
]
Calibrations = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option(
        "--calibration",
        metavar="CAMERA=FILE",
        help="Use these camera intrinsics: a calibration file of OpenCV, ROS, Kalibr or others, or a "
        "log with them. Repeat it for each camera; a log without CAMERA= gives the intrinsics of all.",
    ),
]
Corners = Annotated[Optional[str], build_option(CORNERS)]  # noqa: UP045
Method = Annotated[str, build_option(METHOD)]
Only = Annotated[
    Optional[list[str]],  # noqa: UP045
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
ModelOfOther = Annotated[
    OtherLog,
    other_log_option(
        "--model-from",
        help="While measuring, compare each point with the model of this log, a file or a URL.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def load_calibrations(
    options: list[str] | None,
    cameras: Callable[[], Collection[str]],
    assume: Callable[[str, str], None] = lambda camera, text: None,
) -> dict[str, CameraCalibration]:
    """Read intrinsics by camera from ``camera=file``, or from ``other.mcap`` for the given ``cameras``.

    ``assume`` is called with a camera and a text if its file does not state the lens model. The text and
    remarks on unusual values are printed.

    Raises
    ------
    IpsysError
        An option has another form, or a file contains no calibration.
    """
    if not options:
        return {}
    from ipsys_log.errors import IpsysError
    from ipsys_log.exchange.calibration_files import read_intrinsics
    from ipsys_log.log.dataset import Session

    def report(camera: str, text: str) -> None:
        say_remark(camera, text)
        assume(camera, text)

    lenses: dict[str, CameraCalibration] = {}
    for option in options:
        camera, place = split_calibration(option)
        if camera is not None:
            calibrations = {camera: read_intrinsics(place, camera, report)}
        elif place.suffix == ".mcap":
            with Session([place]) as log:
                known = [camera for camera in log.calibrations if camera in cameras()]
            calibrations = {camera: read_intrinsics(place, camera, report) for camera in known}
            if not calibrations:
                raise IpsysError(
                    f"--calibration {place}: has no calibration of these cameras; give another log"
                )
        else:
            raise IpsysError(
                f"--calibration {place}: has no camera name; write camera=file.yaml, or name a log (.mcap)"
            )
        for name in calibrations:
            if name in lenses:
                raise IpsysError(f"--calibration: camera {name!r} has two calibrations; give one")
        lenses.update(calibrations)
    say_unusual(lenses)
    return lenses


def say_remark(camera: str, text: str) -> None:
    """Print a remark on the calibration of a camera."""
    remarks.print(f"camera {camera}: {text}", style="yellow", markup=False)


def say_unusual(lenses: Mapping[str, CameraCalibration]) -> None:
    """Print remarks on unusual values of calibrations."""
    from ipsys_log.geometry.plausible_lenses import calibration_remarks

    for camera, lens in sorted(lenses.items()):
        for text in calibration_remarks(lens):
            say_remark(camera, text)


def split_calibration(option: str) -> tuple[str | None, LogLocation]:
    """Return the camera and the file of ``camera=file``; the camera is None if the option names only a log.

    The query of a URL may have an equals sign, too.
    """
    from ipsys_log.log.location import LogUrl, parse_location

    camera, equals, name = option.partition("=")
    if not equals or isinstance(parse_location(option), LogUrl):
        return None, parse_location(option)
    return camera, parse_location(name)


def load_matching_rig(path: Path | None, cameras: Callable[[], Collection[str]]) -> Rig | None:
    """Read a rig for cameras that are given by their images; None if no file is named.

    A rig that describes only some of the cameras causes a remark.

    Raises
    ------
    IpsysError
        The rig cannot be read, or describes only other cameras.
    """
    if path is None:
        return None
    from ipsys_log.rig.file import check_rig_cameras, load_rig

    rig = load_rig(path)
    for text in check_rig_cameras(rig, cameras(), f"--rig {path}"):
        remarks.print(text, style="yellow", markup=False)
    return rig


def load_lab(
    rig: Path, calibration: list[str] | None, only: Collection[str], with_lenses: bool = True
) -> Lab:
    """Return the cameras of a rig file that have a source (or ``only`` some), with their intrinsics.

    The intrinsics come from ``calibration``, else from the file that the rig names, relative to the rig file.
    The files of the rig are read only ``with_lenses``.

    Raises
    ------
    IpsysError
        The rig has no such camera, or no camera with a source.
    """
    from ipsys_log.capture.lab import Lab
    from ipsys_log.exchange.lab_files import load_cameras, load_lenses

    described, cameras = load_cameras(rig, only)
    names = [camera.name for camera in cameras]
    assumed: dict[str, str] = {}
    given = load_calibrations(calibration, lambda: names, assumed.__setitem__)
    from_files: dict[str, str] = {}
    lenses = load_lenses(rig, cameras, given, with_lenses, from_files.__setitem__)
    for camera, text in from_files.items():
        say_remark(camera, text)
    say_unusual({camera: lens for camera, lens in lenses.items() if camera not in given})
    return Lab(described, cameras, lenses, rig.parent, assumed | from_files)


def cameras_of(logs: Sequence[LogLocation]) -> set[str]:
    """Return the cameras of which logs have frames or derived channels."""
    from ipsys_log.log.contents import camera_of_topic
    from ipsys_log.log.dataset import Session

    with Session(logs) as session:
        derived = {camera_of_topic(topic) for reader in session.readers for topic in reader.channels}
        return set(session.images) | {camera for camera in derived if camera}
