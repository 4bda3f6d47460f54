"""Recording and live tracking: ``ipsys record`` and ``ipsys live``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from ipsys_log.cli.console import remarks, say
from ipsys_log.cli.dashboard import Web, WebPort, plan_dashboard, serve_dashboard
from ipsys_log.cli.open_cameras import MODEL, check_target, open_cameras, prepare_lab
from ipsys_log.cli.options import (
    Calibrations,
    Corners,
    Force,
    Host,
    Method,
    ModelOfOther,
    NewLog,
    OneLog,
    Only,
    Port,
    RigNow,
    other_log_option,
)
from ipsys_log.cli.signals import allow_interrupt, runs_until_stopped
from ipsys_log.cli.stream_options import StreamOptions, choose_streams, takes_streams

if TYPE_CHECKING:
    from ipsys_log.capture.lab import OpenLab
    from ipsys_log.sinks.rerun.live import LiveView
    from ipsys_log.sinks.sink import Sink
    from ipsys_log.sinks.streams.settings import StreamSettings

Seconds = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option(min=0.1, metavar="SECONDS", help="Stop after this time."),
]
View = Annotated[bool, typer.Option("--view", help="Show cameras and robots in Rerun during the recording.")]

_NOT_BEGUN = "stopped before the first frame was recorded; no log was written"


def add_commands(app: typer.Typer) -> None:
    app.command()(record)
    app.command()(live)


@runs_until_stopped
def record(
    output: NewLog,
    rig: RigNow = Path("lab.toml"),
    camera: Only = None,
    calibration: Calibrations = None,
    detect: Annotated[bool, typer.Option("--detect", help="Detect the markers and write them, too.")] = False,
    corners: Corners = None,
    measure: Annotated[
        bool,
        typer.Option(
            "--measure", help="Enter tape measurements during the recording, on a page for the phone."
        ),
    ] = False,
    host: Host = None,
    port: Port = 8000,
    model_from: ModelOfOther = None,
    seconds: Seconds = None,
    force: Force = False,
) -> None:
    """Record the camera frames, unchanged, until Ctrl-C."""
    allow_interrupt(_NOT_BEGUN)
    from ipsys_log import pipeline
    from ipsys_log.capture.live_plan import check_start
    from ipsys_log.cli.measure_live import live_scene, ready_to_measure, serve_live_page
    from ipsys_log.errors import IpsysError
    from ipsys_log.extras import check_installed
    from ipsys_log.runs.options import Request

    if model_from is not None and not measure:
        raise IpsysError(
            f"--model-from {model_from}: has no effect without --measure; add --measure, or track with: "
            "ipsys live"
        )
    if measure:
        check_installed("--measure needs", "starlette", "uvicorn")
    lab = prepare_lab(rig, camera, calibration)
    read = lab.files if model_from is None else [*lab.files, (MODEL, model_from)]
    check_target(output, force, read)
    request = Request(corners=corners)
    if measure:
        from ipsys_log.web.server import check_port_free

        model = ready_to_measure(lab, request, model_from)
        check_port_free(host, port)
    elif detect:
        check_start(lab.rig, lab.names, lab.lenses, request, "detect")
    with open_cameras(lab, output, seconds) as (opened, status):
        cameras, settings = opened.cameras, opened.settings
        for name in sorted(set(lab.names) - set(lab.lenses)):
            text = (
                f"camera {name} has no calibration, but a replay needs one; write calibration = "
                f'"{name}.yaml" into the rig file'
            )
            remarks.print(text, style="yellow", markup=False)
        if measure:
            scene = live_scene(opened, model)
            with serve_live_page(scene, host, port):
                pipeline.live(cameras, settings, output, request, "camera-frame", [status, scene], force)
        elif detect:
            pipeline.live(cameras, settings, output, request, "detect", [status], force)
        else:
            pipeline.record(cameras, settings, output, [status], force)


@runs_until_stopped
@takes_streams
def live(
    output: NewLog,
    model_from: Annotated[
        OneLog,
        other_log_option("--model-from", help="The log with the fitted model to apply, a file or a URL."),
    ],
    rig: RigNow = Path("lab.toml"),
    model: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--model",
            metavar="NAME",
            help="Model of this log, such as best; repeat it for several. Default: poly, if the log has it.",
        ),
    ] = None,
    camera: Only = None,
    calibration: Calibrations = None,
    corners: Corners = None,
    method: Method = "perimeter",
    view: View = False,
    web: Web = False,
    web_port: WebPort = None,
    *,
    streams: StreamOptions,
    seconds: Seconds = None,
    force: Force = False,
) -> None:
    """Track robots live: record, and process every frame with all stages up to fuse, until Ctrl-C."""
    allow_interrupt(_NOT_BEGUN)
    from ipsys_log import pipeline
    from ipsys_log.capture.live_plan import check_start, shown_run
    from ipsys_log.extras import check_installed
    from ipsys_log.runs.options import Request
    from ipsys_log.sinks.streams.settings import check_streams, open_live_streams

    for option, is_wanted in (("--view", view), ("--rerun", streams["rerun"])):
        if is_wanted:
            check_installed(f"{option} needs", "rerun")
    if web:
        check_installed("--web needs", "starlette", "uvicorn")
    lab = prepare_lab(rig, camera, calibration)
    check_target(output, force, [*lab.files, (MODEL, model_from)])
    models = tuple(dict.fromkeys(model or ()))
    request = Request(models=models, model_from=model_from, corners=corners, method=method)
    for line in check_start(lab.rig, lab.names, lab.lenses, request, None):
        remarks.print(line, style="yellow", markup=False)
    planned = plan_dashboard(web, streams["host"], web_port, request)
    streamed = choose_streams(lab.rig, rig.parent, has_page=web, **streams)
    for line in check_streams(streamed):
        say(line)
    if streamed and not lab.rig.robot_heights_m():
        text = f"{rig}: names no robots; the streams name them marker_<id>. Add robot = NAME to [[markers]]"
        remarks.print(text, style="yellow", markup=False)
    run = shown_run(request)
    with (
        open_cameras(lab, output, seconds) as (opened, status),
        open_live_streams(streamed, opened, run) as senders,
        _page_viewer(opened, run, streamed) as pages,
        serve_dashboard(planned, opened, status, output, run, senders) as dashboards,
    ):
        viewer = [_viewer(opened, run)] if view else []
        sinks: list[Sink] = [status, *viewer, *pages, *dashboards, *senders]
        pipeline.live(opened.cameras, opened.settings, output, request, None, sinks, force)


def _viewer(opened: OpenLab, run: str) -> LiveView:
    from ipsys_log.sinks.rerun.live import LiveView

    return LiveView(opened.rig, opened.cameras.states, run, say)


@contextmanager
def _page_viewer(opened: OpenLab, run: str, streamed: StreamSettings) -> Iterator[list[LiveView]]:
    """Show the recording on a page for a browser of this machine, if the user asked for it."""
    if not streamed.rerun:
        yield []
        return
    from ipsys_log.sinks.rerun.live import LiveView
    from ipsys_log.sinks.rerun.viewer import ViewerPage

    shown = opened.cameras.states if streamed.images else ()
    with closing(ViewerPage()) as page:
        say(page.describe())
        yield [LiveView(opened.rig, shown, run, say, page.show, page.name)]
