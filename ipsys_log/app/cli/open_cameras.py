"""Cameras of a rig that a command opens; all possible checks come before the cameras are opened."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import TIMEOUT_MAX, Timer
from time import monotonic
from typing import TYPE_CHECKING

from ipsys_log.app.cli.console import console, remarks, say, warn
from ipsys_log.app.cli.lab_inputs import load_lab, split_calibration
from ipsys_log.app.cli.signals import Interrupted, stop_on_signal
from ipsys_log.app.report.files import check_file
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation, is_one_of
from ipsys_log.units import format_bytes

if TYPE_CHECKING:
    from ipsys_log.app.report.cameras import LiveStatus
    from ipsys_log.capture.disk import DiskRoom
    from ipsys_log.capture.lab import Lab, OpenLab


# The name of a log that exists only while the command runs.
SENT_NOW = "the camera images"
# The description of the log of --model-from in messages.
MODEL = "the log with the model"
# Duration of the frames that are kept for a measured point.
_PLACE_S = 1.5
# The first frame is processed within this time, also on a busy computer.
_FIRST_FRAME_S = 60.0


def prepare_lab(
    rig: Path, only: list[str] | None, calibration: list[str] | None, with_lenses: bool = True
) -> Lab:
    """Return the cameras of a rig file; no camera is opened yet.

    Parameters
    ----------
    only : the names of some cameras; otherwise all cameras with a source.
    with_lenses : also read the intrinsics that the rig names; False if they do not exist yet.
    """
    from ipsys_log.capture.devices import check_sources, usb_advice

    lab = load_lab(rig, calibration, only or (), with_lenses)
    lab = replace(lab, files=_files_of(lab, calibration))
    check_sources(lab.cameras)
    for line in usb_advice(replace(lab.rig, cameras=tuple(lab.cameras))):
        warn(line)
    for camera in lab.cameras:
        if camera.width and camera.height and camera.width < camera.height:
            text = f"camera {camera.name}: {camera.width} x {camera.height} px is upright"
            warn(f"{text}: check that width and height are not exchanged")
    return lab


def _files_of(lab: Lab, calibration: list[str] | None) -> list[tuple[str, LogLocation]]:
    """Return the input files of a lab with their names in messages."""
    from ipsys_log.capture.video_files import split_source

    files = [("a calibration", split_calibration(option)[1]) for option in calibration or ()]
    for camera in lab.cameras:
        if camera.calibration is not None:
            files.append((f"the calibration of camera {camera.name}", lab.folder / camera.calibration))
        if str(camera.source).startswith("file:"):
            files.append((f"the source of camera {camera.name}", split_source(str(camera.source))[0]))
    return files


def check_target(output: Path, force: bool, files: Iterable[tuple[str, LogLocation]]) -> None:
    """Check that a log can be written.

    Parameters
    ----------
    files : the input files with their names in messages: they must not be overwritten.

    Raises
    ------
    IpsysError
        The log exists, its folder does not exist, or the folder accepts no files or no such file name; with
        ``force``, another process is writing the log.
    """
    from ipsys_log.log.journal import DISK, check_free, check_locks, journal_path, open_locked

    try:
        journal_path(output).exists()
    except OSError as error:
        shorter = "; choose a shorter name" if error.errno == errno.ENAMETOOLONG else ""
        raise IpsysError(f"-o {output}: {error.strerror}{shorter}") from error
    check_file(output, "-o", [])
    if not output.exists():
        check_free(output)
        check_locks(output.parent)
    else:
        for purpose, log in files:
            if is_one_of(output, [log]):
                raise IpsysError(f"-o {output}: is {purpose}; give another name")
        if not force:
            raise IpsysError(f"{output}: exists already; give another name, or --force to overwrite it")
        os.close(open_locked(DISK, output, os.O_RDWR))


@contextmanager
def open_cameras(
    lab: Lab,
    output: Path,
    seconds: float | None,
    doing: str | None = None,
    panel: bool = True,
    until_stopped: bool = True,
) -> Iterator[tuple[OpenLab, LiveStatus]]:
    """Open the cameras; yield them, and the status on the screen.

    Parameters
    ----------
    doing : text printed at the start of a command that does not record; without it, the end reports frames.
    panel : the screen is free for a table of the cameras.
    until_stopped : a signal stops the cameras, and the command ends in order; otherwise it interrupts.
    """
    from ipsys_log.app.report.cameras import LiveStatus
    from ipsys_log.capture.lab import open_lab
    from ipsys_log.capture.live_check import CameraMonitor

    with ExitStack() as stack:
        with remarks.status("opening " + ", ".join(lab.names)):
            opened = stack.enter_context(open_lab(lab, say))
        begun = stack.enter_context(_stop_after(opened.cameras.stop, seconds, until_stopped))
        room = opened.room(output)
        # A log without a recording grows only with measured points.
        growing = None if doing and seconds is None else room.bytes_per_s
        monitor = stack.enter_context(CameraMonitor(lab.rig))
        status = LiveStatus(
            opened.cameras.states, monitor, output, monotonic, growing, None if doing else say,
            cameras=lab.cameras, positions=opened.cameras.positions, begun=begun,
        )  # fmt: skip
        _say_room(opened, room, seconds, doing)
        say(doing or "the cameras are open; Ctrl-C to end")
        if panel:
            stack.enter_context(_on_screen(status))
        yield opened, status
    for line in () if doing else status.summary():
        console.print(line)


def _say_room(opened: OpenLab, room: DiskRoom, seconds: float | None, doing: str | None) -> None:
    """Print the expected size of the recording and how long the disk lasts, before it begins.

    If frames are taken only for some seconds, the text is printed only if the disk is too small for them.
    """
    if doing and not (seconds is not None and room.is_short(seconds)):
        if seconds is None:
            place, free = format_bytes(round(_PLACE_S * room.bytes_per_s)), format_bytes(room.free_bytes)
            say(f"about {place} for each point; {free} free in {room.folder}")
        return
    short = room.is_short(seconds)
    remarks.print(room.describe(seconds), style="bold red" if short else None)
    if advice := room.advise(opened.lab.cameras, opened.cameras.states):
        say(advice)


@contextmanager
def _stop_after(
    stop: Callable[[], None], seconds: float | None, on_signal: bool = True
) -> Iterator[Callable[[], None]]:
    """Stop in order after some time, or on the first signal: messages that arrived before are written.

    The time begins with a call of the yielded function. If none comes for long, it begins without.
    """
    if on_signal:
        stop_on_signal(stop)
    timer: Timer | None = None

    def begin(after_s: float = 0.0) -> None:
        nonlocal timer
        if timer is not None:
            timer.cancel()
        timer = Timer(TIMEOUT_MAX if seconds is None else after_s + seconds, stop)
        timer.daemon = True
        timer.start()

    begin(_FIRST_FRAME_S)
    try:
        yield begin
    finally:
        if timer is not None:
            timer.cancel()


def _on_screen(status: LiveStatus) -> AbstractContextManager[object]:
    from rich.live import Live

    if not remarks.is_terminal:
        return nullcontext()
    return Live(get_renderable=status.show, console=remarks, transient=True, refresh_per_second=2)


@contextmanager
def record_now(lab: Lab, seconds: float, keep: Path | None = None) -> Iterator[Path]:
    """Record the cameras for some seconds; without ``keep`` the log is deleted after the block.

    Raises
    ------
    IpsysError
        The cameras do not send. Errors of the block do not name the temporary file.
    """
    from ipsys_log.live_runs import pipeline

    with TemporaryDirectory(prefix="ipsys-") as folder:
        log = keep or Path(folder) / "now.mcap"
        doing = None if keep else f"recording for {seconds:g} s"
        try:
            with open_cameras(lab, log, seconds, doing, until_stopped=False) as (opened, status):
                pipeline.record(opened.cameras, opened.settings, log, [status])
        except Interrupted as interrupt:
            kept = (
                f"{keep} has the frames before the interruption"
                if keep and keep.exists()
                else "no frame was kept"
            )
            raise Interrupted(interrupt.exit_code, f"interrupted; {kept}") from None
        try:
            yield log
        except IpsysError as error:
            if keep is not None:
                raise
            raise IpsysError(str(error).replace(str(log), SENT_NOW)) from error
