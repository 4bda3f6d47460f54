"""From cameras that send now: ``ipsys record`` and ``ipsys live``."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from threading import Timer
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.options import Calibrations, Corners, Method, NewLog, load_lab

if TYPE_CHECKING:
    from ipsys_log.messages import Message
    from ipsys_log.report.cameras import LiveStatus
    from ipsys_log.request import Request
    from ipsys_log.sinks.rerun_live import LiveView
    from ipsys_log.sources.attached import Attached

__all__ = ["add_commands"]

Lab = Annotated[Path, typer.Option("--rig", help="The rig file; each camera has a source there.")]
Only = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--camera", metavar="NAME", help="Only this camera of the rig; repeat it for several."),
]
Seconds = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option(min=0.1, help="Stop by itself after so many seconds."),
]
View = Annotated[bool, typer.Option("--view", help="Show cameras and robots in Rerun meanwhile.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite the log if there is one of that name.")]


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
    seconds: Seconds = None,
    force: Force = False,
) -> None:
    """Record the frames of the cameras as they come, until Ctrl-C."""
    from ipsys_log import pipeline
    from ipsys_log.request import Request

    with _opened(output, rig, camera, calibration, seconds, force) as (cameras, settings, status):
        if detect:
            pipeline.live(cameras, settings, output, Request(corners=corners), "detect", status)
        else:
            pipeline.record(cameras, settings, output, status)


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
    from ipsys_log.request import Request

    models = () if model is None else (model,)
    request = Request(models=models, model_from=model_from, corners=corners, method=method)
    with (
        _opened(output, rig, camera, calibration, seconds, force) as (cameras, settings, status),
        _viewed(settings, cameras, request) if view else nullcontext() as viewer,
    ):

        def watch(message: Message | None) -> None:
            status(message)
            if viewer is not None:
                viewer(message)

        pipeline.live(cameras, settings, output, request, "fuse", watch)


def _viewed(settings: list[Message], cameras: Attached, request: Request) -> LiveView:
    from ipsys_log.lookup import wanted_models
    from ipsys_log.sinks.rerun_live import LiveView
    from ipsys_log.tasks import model_run

    (model,) = wanted_models(request, "fuse")
    return LiveView(settings[0].payload, cameras.states, model_run(model), remarks.print)


@contextmanager
def _opened(
    output: Path,
    rig: Path,
    only: list[str] | None,
    calibration: list[str] | None,
    seconds: float | None,
    force: bool,
) -> Iterator[tuple[Attached, list[Message], LiveStatus]]:
    """Cameras that send, what is written first, and what is shown on the screen meanwhile."""
    from rich.live import Live

    from ipsys_log.monitor import Monitor
    from ipsys_log.recording import first_messages, fitting_lenses
    from ipsys_log.report.cameras import LiveStatus
    from ipsys_log.sources.attached import Attached
    from ipsys_log.sources.devices import open_source
    from ipsys_log.sources.frames import Clock

    lab, cameras, lenses = load_lab(rig, calibration, only or ())
    _check_target(output, force)
    with ExitStack() as stack:
        with remarks.status("opening " + ", ".join(camera.name for camera in cameras)):
            attached = stack.enter_context(Attached(cameras, open_source, Clock()))
        sizes_px = {name: state.size_px for name, state in attached.states.items()}
        lenses = fitting_lenses(lenses, sizes_px, remarks.print)
        if force:
            output.unlink(missing_ok=True)
        _stop_on_signals(attached.stop)
        if seconds is not None:
            timer = Timer(seconds, attached.stop)
            stack.callback(timer.cancel)
            timer.start()
        status = LiveStatus(attached.states, stack.enter_context(Monitor(lab)), output, monotonic)
        remarks.print(f"recording into {output}; Ctrl-C ends it")
        if remarks.is_terminal:
            stack.enter_context(
                Live(get_renderable=status.show, console=remarks, transient=True, refresh_per_second=2)
            )
        yield attached, first_messages(lab, lenses, attached.now_ns), status
    for line in status.summary():
        console.print(line)


def _check_target(output: Path, force: bool) -> None:
    from ipsys_log.errors import IpsysError

    if output.exists() and not force:
        raise IpsysError(f"{output}: exists already; give another name, or --force to overwrite it")
    if not output.absolute().parent.is_dir():
        raise IpsysError(f"{output}: there is no folder {output.parent}; make it first")


def _stop_on_signals(stop: Callable[[], None]) -> None:
    """End cleanly: what the cameras have sent by then is written."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop())
