"""Calibration of camera intrinsics from images of a board: ``ipsys calibrate``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.app.cli.console import console, print_json, progress_bar, say, warn
from ipsys_log.app.cli.open_cameras import SENT_NOW, prepare_lab, record_now
from ipsys_log.app.cli.options import AsJson, figure_option, file_log_argument, setting, switch
from ipsys_log.app.cli.signals import note_kept, say_kept
from ipsys_log.app.report.files import check_file, check_folder, write_files
from ipsys_log.errors import IpsysError

if TYPE_CHECKING:
    from ipsys_log.calibration.calibrate import CalibrationResult, Failure
    from ipsys_log.capture.lab import Lab

Sources = Annotated[
    list[Path] | None, file_log_argument(help="Logs, folders of images, images or videos.", metavar="SOURCE")
]
RigNow = Annotated[
    Path | None,
    setting("--rig", "FILE", "Without SOURCE: use the cameras of this rig now. With --write: write into it."),
]
Write = Annotated[bool, switch("--write", "Name the new file of each camera in --rig.")]
Seconds = Annotated[
    float, setting("--seconds", "SECONDS", "Without SOURCE: duration, while you move the board.", min=1.0)
]
BoardName = Annotated[
    str,
    setting(
        "--board",
        "COLUMNSxROWS",
        "Inner corners of a chessboard, such as 6x4, or squares of a ChArUco board, such as charuco:4x5.",
    ),
]
Square = Annotated[
    float, setting("--square", "METRES", "Side of a square, in m. It does not change the intrinsics.")
]
MarkerScale = Annotated[
    float,
    setting("--marker-scale", "SHARE", "Side of a ChArUco marker, as a fraction of the side of a square."),
]
Dictionary = Annotated[str, setting("--dictionary", "NAME", "Dictionary of the markers of a ChArUco board.")]
Inverted = Annotated[bool, switch("--inverted", "The board has black and white exchanged.")]
Lens = Annotated[
    str,
    setting(
        "--lens",
        "NAME",
        "Distortion model: fisheye (Kannala-Brandt, k1 to k4), pinhole (k1 k2 p1 p2 k3), pinhole4 "
        "(without k3) or pinhole8 (with k4 k5 k6).",
    ),
]
Cameras = Annotated[
    list[str] | None,
    setting(
        "--camera",
        "CAMERA",
        "Use only this camera of the log or rig; repeat it for several. With images or a video: the "
        "name of the camera.",
    ),
]
Output = Annotated[
    Path, setting("--output,-o", "PATH", "Folder of the files, or one file, such as red.yaml.")
]
Formats = Annotated[
    list[str] | None,
    setting("--format", "NAME", "File format: opencv (the default), ros or kalibr; repeat it for several."),
]
Plot = Annotated[Path | None, figure_option("coverage and residuals")]
Force = Annotated[
    bool,
    switch(
        "--force",
        "Write a result that a check refuses: the file exists; most images show a larger board than "
        "--board; RMS above 2 px; fewer than 5 images; images of two cameras.",
    ),
]


@say_kept(lambda written: f"written: {', '.join(written)}" if written else "no file was written")
def calibrate(
    board: BoardName,
    sources: Sources = None,
    square: Square = 0.03,
    lens: Lens = "fisheye",
    marker_scale: MarkerScale = 0.75,
    dictionary: Dictionary = "DICT_4X4_50",
    inverted: Inverted = False,
    camera: Cameras = None,
    output: Output = Path(),
    formats: Formats = None,
    plot: Plot = None,
    rig: RigNow = None,
    write: Write = False,
    seconds: Seconds = 60.0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate camera intrinsics from images of a chessboard or a ChArUco board.

    The command writes one file for each camera that saw the board, with the name of the camera. If a camera
    has no result, the files of the others are written, and the exit code is 1. Sharp, different images are
    selected automatically; two dozen with the board in all parts of the image are enough.

    Examples

        ipsys calibrate photos/red --board 6x4              # a folder: red.yaml
        ipsys calibrate --rig lab.toml --board 6x4 --write  # use the cameras now
        ipsys calibrate red.mp4 --board charuco:4x5 --camera red --plot red.png
    """
    from ipsys_log.api import python_api as api
    from ipsys_log.calibration.board import parse_board
    from ipsys_log.calibration.calibrate import CalibrationResult
    from ipsys_log.calibration.images import find_sources
    from ipsys_log.calibration.lens_models import find_lens_model
    from ipsys_log.exchange.calibration_files import check_format

    find_lens_model(lens)
    parse_board(board, square, marker_scale, dictionary, inverted)
    names = list(dict.fromkeys(formats or ["opencv"]))
    for name in names:
        check_format(name, lens)
    if plot is not None:
        _check_free(plot, force)
    if write:
        _check_write(rig, camera, names)
    lab = None if sources else _prepare_now(rig, camera, board)
    if lab is not None:
        _targets(lab.names, output, names, force)
    with nullcontext(sources or []) if lab is None else _record_now(lab, seconds) as taken:
        image_sources = find_sources(taken, camera or [])
        targets = _targets([pictures.camera for pictures in image_sources], output, names, force)
        with progress_bar(frame_steps=()) as progress:
            outcomes: list[CalibrationResult | Failure] = []
            for outcome in api.calibrate(
                *taken,
                board=board,
                square_m=square,
                lens=lens,
                marker_scale=marker_scale,
                dictionary=dictionary,
                inverted=inverted,
                cameras=camera or (),
                force=force,
                progress=progress,
            ):
                if isinstance(outcome, CalibrationResult):
                    _write(outcome, targets[outcome.camera])
                    if write and rig is not None:
                        _write_into(rig, outcome.camera, targets[outcome.camera]["opencv"])
                    outcomes.append(outcome)
                else:  # a temporary log is deleted before the user reads the reason
                    reason = outcome.reason.replace(str(taken[0]), SENT_NOW) if lab else outcome.reason
                    outcomes.append(outcome._replace(reason=reason))
    lenses = [outcome for outcome in outcomes if isinstance(outcome, CalibrationResult)]
    if plot is not None and lenses:
        from ipsys_log.app.report.calibration_figures import calibration_figure
        from ipsys_log.app.report.figures import save_figure

        save_figure(calibration_figure(lenses), plot, 110)
    _print_outcomes(outcomes, targets, plot, as_json, for_rig="opencv" in names and not write)


def _print_outcomes(
    outcomes: list[CalibrationResult | Failure],
    targets: dict[str, dict[str, Path]],
    plot: Path | None,
    as_json: bool,
    for_rig: bool,
) -> None:
    """Print the results, then a line for each camera without a result; exit with 1 if a result is missing."""
    from ipsys_log.calibration.calibrate import Failure

    failures = [outcome for outcome in outcomes if isinstance(outcome, Failure)]
    if len(failures) == len(outcomes) == 1:
        raise IpsysError(failures[0].reason)
    if as_json:
        shown = [_json(outcome, targets) for outcome in outcomes]
        print_json(shown)
    for outcome in [] if as_json else outcomes:
        if not isinstance(outcome, Failure):
            _show(outcome, list(targets[outcome.camera].values()), for_rig)
    if plot is not None and len(failures) < len(outcomes) and not as_json:
        say(f"{plot} drawn")
    for failure in failures:
        warn(f"no file for {failure.camera}: {failure.reason}")
    if len(failures) == len(outcomes) or any(failure.expected for failure in failures):
        raise typer.Exit(1)


def _json(outcome: CalibrationResult | Failure, targets: dict[str, dict[str, Path]]) -> dict[str, Any]:
    from ipsys_log.app.report.calibration import calibration_json
    from ipsys_log.calibration.calibrate import Failure

    if isinstance(outcome, Failure):
        return {"camera": outcome.camera, "error": outcome.reason, "files": []}
    return {**calibration_json(outcome), "files": [str(path) for path in targets[outcome.camera].values()]}


def _prepare_now(rig: Path | None, only: list[str] | None, board: str) -> Lab:
    """Return the cameras to calibrate; simulated ones show the calibration board."""
    from ipsys_log.capture.simulated import show_board

    if rig is None:
        raise IpsysError(
            "no source is given; name images, a video or a log of a board, or give --rig lab.toml to use "
            "its cameras now"
        )
    lab = prepare_lab(rig, only, None, with_lenses=False)
    return replace(lab, cameras=[show_board(camera, board) for camera in lab.cameras])


@contextmanager
def _record_now(lab: Lab, seconds: float) -> Iterator[list[Path]]:
    say(
        "move the board over the whole image of each camera, tilt it to all sides, and hold it still often; "
        "the frames are not kept"
    )
    with record_now(lab, seconds) as log:
        yield [log]


def _targets(cameras: list[str], output: Path, formats: list[str], force: bool) -> dict[str, dict[str, Path]]:
    """Return the path of the file of each camera and format; raise if it cannot be written."""
    from ipsys_log.exchange.calibration_files import FORMATS

    if output.suffix.lower() in (".yaml", ".yml"):
        if len(cameras) > 1 or len(formats) > 1:
            raise IpsysError(f"--output {output}: is one file, but there are several cameras; name a folder")
        targets = {cameras[0]: {formats[0]: output}}
        check_file(output, "--output", [])
    else:
        check_folder(output, "--output")
        targets = {
            camera: {name: output / f"{camera}{FORMATS[name][1]}.yaml" for name in formats}
            for camera in cameras
        }
    for paths in targets.values():
        for path in paths.values():
            _check_free(path, force)
    return targets


def _check_free(path: Path, force: bool) -> None:
    from ipsys_log.log.location import describe_broken_link

    if (text := describe_broken_link(path)) is not None:
        raise IpsysError(text)
    if path.exists() and not force:
        raise IpsysError(f"{path}: exists already; choose another --output, or give --force to overwrite it")


def _check_write(rig: Path | None, cameras: list[str] | None, formats: list[str]) -> None:
    """Check that the results can be named in the rig file, before the calibration begins."""
    from ipsys_log.messages.rig_file import load_rig

    if rig is None:
        raise IpsysError("--write: has no rig file to write into; add --rig lab.toml")
    if "opencv" not in formats:
        raise IpsysError("--write: lab.toml names files in the format opencv; add --format opencv")
    known = [camera.name for camera in load_rig(rig).cameras]
    for name in cameras or []:
        if name not in known:
            raise IpsysError(f"--camera {name}: {rig} has the cameras {', '.join(known) or 'none'}")


def _write_into(rig: Path, camera: str, file: Path) -> None:
    """Name the file of a camera in the rig file, relative to its folder."""
    from ipsys_log.app.first_day.camera_choice import set_calibration
    from ipsys_log.messages.rig_file import load_rig

    if camera not in [one.name for one in load_rig(rig).cameras]:
        warn(f"{rig}: has no camera {camera}; add it, with calibration = {file.as_posix()!r}")
        return
    set_calibration(rig, camera, os.path.relpath(file, rig.parent).replace(os.sep, "/"))
    say(f"{rig}: camera {camera} has this calibration now")


def _write(one: CalibrationResult, paths: dict[str, Path]) -> None:
    """Write the files of a camera, one for each format."""
    from ipsys_log.exchange.calibration_files import calibration_text

    contents = {path: calibration_text(one, name).encode() for name, path in paths.items()}
    for folder in dict.fromkeys(path.parent for path in contents):
        write_files(folder, {path.name: data for path, data in contents.items() if path.parent == folder})
        note_kept(", ".join(str(path) for path in contents if path.parent == folder))


def _show(one: CalibrationResult, files: list[Path], for_rig: bool) -> None:
    from ipsys_log.app.report.calibration import calibration_lines, calibration_table

    console.print(calibration_table(one))
    for line in calibration_lines(one):
        console.print(line)
    for note in one.notes:
        warn(f"{one.camera}: {note}")
    for path in files:
        console.print(f"{path} written")
    if for_rig:
        console.print(f'put into lab.toml, under [[cameras]] with name = "{one.camera}":')
        console.print(f'calibration = "{files[0].as_posix()}"\n')
