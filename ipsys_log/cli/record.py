"""From cameras that send now: ``ipsys record`` and ``ipsys live``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from ipsys_log.cli.cameras_now import check_target, opened, prepared, say
from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.measure import Host, Port
from ipsys_log.cli.options import Calibrations, Corners, Method, NewLog

if TYPE_CHECKING:
    from ipsys_log.live_scene import LiveScene
    from ipsys_log.messages import Message, Model
    from ipsys_log.pipeline import Watch
    from ipsys_log.request import Request
    from ipsys_log.sinks.rerun_live import LiveView
    from ipsys_log.sources.attached import Attached

__all__ = ["add_commands"]

RigNow = Annotated[
    Path, typer.Option("--rig", metavar="FILE", help="The rig file; each camera has a source there.")
]
Only = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--camera", metavar="NAME", help="Only this camera of the rig; repeat it for several."),
]
Seconds = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option(min=0.1, metavar="SECONDS", help="Stop by itself after so many seconds."),
]
View = Annotated[bool, typer.Option("--view", help="Show cameras and robots in Rerun meanwhile.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite the log if there is one of that name.")]


def add_commands(app: typer.Typer) -> None:
    app.command()(record)
    app.command()(live)


def record(
    output: NewLog,
    rig: RigNow = Path("lab.toml"),
    camera: Only = None,
    calibration: Calibrations = None,
    detect: Annotated[bool, typer.Option("--detect", help="Find the markers and write them too.")] = False,
    corners: Corners = None,
    measure: Annotated[
        bool, typer.Option("--measure", help="Enter tape measurements meanwhile, on a page for the phone.")
    ] = False,
    host: Host = None,
    port: Port = 8000,
    model_from: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            "--model-from", metavar="LOG", help="While measuring, say where this log's model puts a place."
        ),
    ] = None,
    seconds: Seconds = None,
    force: Force = False,
) -> None:
    """Record the frames of the cameras as they come, until Ctrl-C."""
    from ipsys_log import pipeline
    from ipsys_log.errors import IpsysError
    from ipsys_log.live_plan import check_start
    from ipsys_log.measuring.entry import check_references
    from ipsys_log.request import Request

    if model_from is not None and not measure:
        raise IpsysError(f"--model-from {model_from}: has no effect without --measure; to track: ipsys live")
    lab = prepared(rig, camera, calibration)
    request = Request(corners=corners)
    until = "camera-frame" if measure else "detect"
    fitted = None if model_from is None else _fitted(model_from, lab.names)
    if measure:
        from ipsys_log.web.serving import check_free

        check_references(lab.rig)
        check_free(host, port)
    if measure or detect:
        check_start(lab.rig, lab.names, lab.lenses, request, until)
    check_target(output, force)
    with opened(lab, output, seconds) as (cameras, settings, status):
        if not (measure or detect):
            pipeline.record(cameras, settings, output, status, force)
            return
        with _measured(settings, cameras, fitted, host, port) if measure else nullcontext() as scene:
            pipeline.live(cameras, settings, output, request, until, _both(status, scene), force)


def live(
    output: NewLog,
    model_from: Annotated[
        Path, typer.Option("--model-from", metavar="LOG", help="The log with the fitted model to apply.")
    ],
    rig: RigNow = Path("lab.toml"),
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
    from ipsys_log.live_plan import check_start
    from ipsys_log.request import Request

    if output.exists() and model_from.exists() and output.samefile(model_from):
        raise IpsysError(f"-o {output}: is the log with the model; give another name")
    lab = prepared(rig, camera, calibration)
    models = () if model is None else (model,)
    request = Request(models=models, model_from=model_from, corners=corners, method=method)
    for line in check_start(lab.rig, lab.names, lab.lenses, request, "fuse"):
        remarks.print(line, style="yellow", markup=False)
    check_target(output, force)
    with (
        opened(lab, output, seconds) as (cameras, settings, status),
        _viewed(settings, cameras, request) if view else nullcontext() as viewer,
    ):
        pipeline.live(cameras, settings, output, request, "fuse", _both(status, viewer), force)


def _fitted(log: Path, cameras: list[str]) -> Model:
    """The newest model of another log, which is of some of the cameras."""
    from ipsys_log.live_plan import check_model
    from ipsys_log.log.session import Session
    from ipsys_log.lookup import fitted_in

    with Session([log]) as other:
        model, _ = fitted_in(other, None)
    check_model(model, cameras)
    return model


def _both(first: Watch, second: Watch | None) -> Watch:
    def watch(message: Message | None) -> None:
        first(message)
        if second is not None:
            second(message)

    return watch


@contextmanager
def _measured(
    settings: list[Message], cameras: Attached, model: Model | None, host: str | None, port: int
) -> Iterator[LiveScene]:
    """The page on which places are measured while they are recorded."""
    from ipsys_log.live_scene import LiveScene
    from ipsys_log.web.serving import qr_code, serving

    scene = LiveScene(settings[0].payload, model, list(cameras.states), cameras.add)
    with serving(scene, host, port) as page:
        if host is not None:
            console.print(qr_code(page.url), style="#ffffff on #000000", markup=False)
        remarks.print(f"measure at {page.url}", markup=False)
        yield scene
        scene.end()


def _viewed(settings: list[Message], cameras: Attached, request: Request) -> LiveView:
    from ipsys_log.lookup import wanted_models
    from ipsys_log.sinks.rerun_live import LiveView
    from ipsys_log.tasks import model_run

    (model,) = wanted_models(request, "fuse")
    return LiveView(settings[0].payload, cameras.states, model_run(model), say)
