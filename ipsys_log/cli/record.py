"""From cameras that send now: ``ipsys record`` and ``ipsys live``."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import TIMEOUT_MAX, Timer
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.options import (
    Calibrations,
    Corners,
    Force,
    Host,
    Method,
    ModelOfOther,
    NewLog,
    Only,
    Port,
    load_lab,
)

if TYPE_CHECKING:
    from ipsys_log.messages import Message, Rig, RigCamera
    from ipsys_log.pipeline import Watch
    from ipsys_log.report.cameras import LiveStatus
    from ipsys_log.request import Request
    from ipsys_log.sinks.rerun_live import LiveView
    from ipsys_log.sources.attached import Attached

__all__ = ["add_commands", "opened_cameras", "recorded_now", "shown_to"]

Lab = Annotated[Path, typer.Option("--rig", help="The rig file; each camera has a source there.")]
Seconds = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option(min=0.1, help="Stop by itself after so many seconds."),
]
View = Annotated[bool, typer.Option("--view", help="Show cameras and robots in Rerun meanwhile.")]


def add_commands(app: typer.Typer) -> None:
    app.command()(record)
    app.command()(live)


def record(
    output: NewLog,
    rig: Lab = Path("lab.toml"),
    camera: Only = None,
    calibration: Calibrations = None,
    detect: Annotated[bool, typer.Option("--detect", help="Find the markers and write them too.")] = False,
    corners: Corners = None,
    measure: Annotated[
        bool, typer.Option("--measure", help="Enter tape measurements meanwhile, on a page for the phone.")
    ] = False,
    host: Host = None,
    port: Port = 8000,
    model_from: ModelOfOther = None,
    seconds: Seconds = None,
    force: Force = False,
) -> None:
    """Record the frames of the cameras as they come, until Ctrl-C."""
    from ipsys_log import pipeline
    from ipsys_log.cli.measure_now import live_scene, served
    from ipsys_log.request import Request

    with opened_cameras(output, rig, camera, calibration, seconds, force) as (cameras, settings, status):
        if measure:
            scene = live_scene(settings, cameras, model_from)
            with served(scene, host, port):
                watch = shown_to(status, scene)
                request = Request(corners=corners)
                pipeline.live(cameras, settings, output, request, "camera-frame", watch, force)
        elif detect:
            pipeline.live(cameras, settings, output, Request(corners=corners), "detect", status, force)
        else:
            pipeline.record(cameras, settings, output, status, force)


def live(
    output: NewLog,
    model_from: Annotated[
        Path, typer.Option("--model-from", metavar="LOG", help="The log with the fitted model to apply.")
    ],
    rig: Lab = Path("lab.toml"),
    model: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--model", metavar="NAME", help="Which of its models, such as best; poly if it has that."
        ),
    ] = None,
    camera: Only = None,
    calibration: Calibrations = None,
    corners: Corners = None,
    method: Method = "perimeter",
    view: View = False,
    seconds: Seconds = None,
    force: Force = False,
) -> None:
    """Track robots now: record, and take every frame through all stages up to fuse, until Ctrl-C."""
    from ipsys_log import pipeline
    from ipsys_log.errors import IpsysError
    from ipsys_log.request import Request

    if output.exists() and model_from.exists() and output.samefile(model_from):
        raise IpsysError(f"-o {output}: is the log with the model; give another name")
    models = () if model is None else (model,)
    request = Request(models=models, model_from=model_from, corners=corners, method=method)
    with (
        opened_cameras(output, rig, camera, calibration, seconds, force) as (cameras, settings, status),
        _viewed(settings, cameras, request) if view else nullcontext() as viewer,
    ):
        pipeline.live(cameras, settings, output, request, "fuse", shown_to(status, viewer), force)


@contextmanager
def recorded_now(rig: Path | None, calibration: list[str] | None, seconds: float) -> Iterator[Path]:
    """A log of what the cameras of a rig send in the next seconds, for as long as the block lasts.

    Raises
    ------
    IpsysError
        Without a rig, or where its cameras do not send.
    """
    from ipsys_log import pipeline
    from ipsys_log.errors import IpsysError

    if rig is None:
        raise IpsysError("name a log, or give --rig lab.toml to take what its cameras send now")
    with TemporaryDirectory(prefix="ipsys-") as folder:
        log = Path(folder) / "now.mcap"
        with opened_cameras(
            log, rig, None, calibration, seconds, False, f"looking for {seconds:g} s"
        ) as opened:
            cameras, settings, status = opened
            pipeline.record(cameras, settings, log, status)
        yield log


def say(text: str) -> None:
    remarks.print(text, markup=False)


def shown_to(first: Watch, second: Watch | None) -> Watch:
    def watch(message: Message | None) -> None:
        first(message)
        if second is not None:
            second(message)

    return watch


def _viewed(settings: list[Message], cameras: Attached, request: Request) -> LiveView:
    from ipsys_log.lookup import wanted_models
    from ipsys_log.sinks.rerun_live import LiveView
    from ipsys_log.tasks import model_run

    (model,) = wanted_models(request, "fuse")
    return LiveView(settings[0].payload, cameras.states, model_run(model), say)


@contextmanager
def opened_cameras(
    output: Path,
    rig: Path,
    only: list[str] | None,
    calibration: list[str] | None,
    seconds: float | None,
    force: bool,
    doing: str | None = None,
    panel: bool = True,
) -> Iterator[tuple[Attached, list[Message], LiveStatus]]:
    """Cameras that send, what is written first, and what is shown on the screen meanwhile.

    Parameters
    ----------
    doing : said at the beginning, where it is not recording; then nothing is said of frames at the end.
    panel : whether the screen is free for a table of the cameras.
    """
    from ipsys_log.monitor import Monitor
    from ipsys_log.recording import first_messages, fitting_lenses
    from ipsys_log.report.cameras import LiveStatus
    from ipsys_log.sources.attached import Attached
    from ipsys_log.sources.devices import open_source
    from ipsys_log.sources.frames import Clock

    lab, cameras, lenses = load_lab(rig, calibration, only or ())
    _check_devices(lab, cameras)
    _check_target(output, force)
    with ExitStack() as stack:
        with remarks.status("opening " + ", ".join(camera.name for camera in cameras)):
            attached = stack.enter_context(Attached(cameras, open_source, Clock(), say))
        sizes_px = {name: state.size_px for name, state in attached.states.items()}
        lenses = fitting_lenses(lenses, sizes_px, say)
        stack.enter_context(_ended(attached.stop, seconds))
        status = LiveStatus(attached.states, stack.enter_context(Monitor(lab)), output, monotonic)
        remarks.print(doing or f"recording into {output}; Ctrl-C ends it", markup=False)
        if panel:
            stack.enter_context(_on_screen(status))
        yield attached, first_messages(lab, lenses, attached.now_ns), status
    for line in () if doing else status.summary():
        console.print(line)


def _check_devices(lab: Rig, cameras: list[RigCamera]) -> None:
    """See that no device is asked for twice, and say what USB will not carry."""
    from ipsys_log.sources.devices import check_devices, usb_advice

    check_devices(cameras)
    for line in usb_advice(replace(lab, cameras=tuple(cameras))):
        remarks.print(line, style="yellow", markup=False)


def _check_target(output: Path, force: bool) -> None:
    from ipsys_log.errors import IpsysError

    if output.exists() and not force:
        raise IpsysError(f"{output}: exists already; give another name, or --force to overwrite it")
    if not output.absolute().parent.is_dir():
        raise IpsysError(f"{output}: there is no folder {output.parent}; make it first")


@contextmanager
def _ended(stop: Callable[[], None], seconds: float | None) -> Iterator[None]:
    """On Ctrl-C, SIGTERM or after some time it ends cleanly: what has come by then is written."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop())
    timer = Timer(TIMEOUT_MAX if seconds is None else seconds, stop)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _on_screen(status: LiveStatus) -> AbstractContextManager[object]:
    from rich.live import Live

    if not remarks.is_terminal:
        return nullcontext()
    return Live(get_renderable=status.show, console=remarks, transient=True, refresh_per_second=2)
