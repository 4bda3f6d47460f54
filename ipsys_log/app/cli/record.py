"""Recording, measuring and live tracking with the cameras of a rig: ``ipsys record`` and ``ipsys live``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Annotated, Any

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import say, warn
from ipsys_log.app.cli.open_cameras import MODEL, check_target, open_cameras, prepare_lab
from ipsys_log.app.cli.options import other_log_option, switch
from ipsys_log.app.cli.pages import Web, WebPort, plan_dashboard, serve_dashboard, serve_measuring
from ipsys_log.app.cli.points import show_measured
from ipsys_log.app.cli.signals import SAVED, allow_interrupt, runs_until_stopped
from ipsys_log.app.cli.stream import StreamOptions, choose_streams, takes_streams
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogLocation

if TYPE_CHECKING:
    from ipsys_log.capture.lab import Lab, OpenLab
    from ipsys_log.capture.multiplexer import LiveCameras
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.survey.live import LiveScene
    from ipsys_log.messages import Measurement, Model
    from ipsys_log.sinks.rerun.viewer import LiveView
    from ipsys_log.sinks.sink import Sink
    from ipsys_log.sinks.streams import StreamSettings

View = Annotated[bool, switch("--view", "Show cameras and robots in Rerun during the recording.")]

_TURN_S = 0.05
# After this time, the markers in the images and their stationary intervals are known.
_LOOK_S = 1.0
_NOT_BEGUN = "stopped before the first frame was recorded; no log was written"


@runs_until_stopped
def record(
    output: cli.NewLog,
    rig: cli.RigNow = Path("lab.toml"),
    camera: cli.Only = None,
    calibration: cli.Calibrations = None,
    detect: Annotated[bool, switch("--detect", "Detect the markers and write them, too.")] = False,
    corners: cli.Corners = None,
    measure: Annotated[
        bool, switch("--measure", "Enter tape measurements during the recording, on a page for the phone.")
    ] = False,
    points_only: Annotated[
        bool, switch("--points-only", "With --measure: keep only about 1 s of frames of each measured point.")
    ] = False,
    terminal: cli.Terminal = False,
    host: cli.Host = None,
    port: cli.Port = 8000,
    model_from: Annotated[
        cli.OtherLog,
        other_log_option(
            "--model-from",
            help="With --measure: compare each point with the model of this log, a file or a URL.",
        ),
    ] = None,
    seconds: cli.Seconds = None,
    force: cli.Force = False,
    as_json: Annotated[bool, switch("--json", "With --points-only: print JSON.", hidden=True)] = False,
) -> None:
    """Record the camera frames, unchanged, until Ctrl-C.

    With --measure, the command checks each entry of a point at once. Undo withdraws a measurement and erases
    nothing.

    Examples

        ipsys record -o monday.mcap                      # the cameras of lab.toml
        ipsys record -o calibration.mcap --measure       # with tape readings
        ipsys record -o cal.mcap --measure --points-only --host 0.0.0.0
        ipsys record -o short.mcap --camera red --seconds 10
    """
    allow_interrupt(SAVED if points_only else _NOT_BEGUN)
    from ipsys_log.capture.live_plan import check_start
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs import pipeline

    if not measure:
        if model_from is not None:
            raise IpsysError(
                f"--model-from {model_from}: has no effect without --measure; add --measure, or track with: "
                "ipsys live"
            )
        if points_only or terminal:
            name = "points-only" if points_only else "terminal"
            raise IpsysError(f"--{name}: has no effect without --measure; add --measure")
    if measure and not terminal:
        check_installed("--measure needs", "starlette", "uvicorn")
    lab = prepare_lab(rig, camera, calibration)
    read = lab.files if model_from is None else [*lab.files, (MODEL, model_from)]
    check_target(output, force, read)
    request = Request(corners=corners)
    if measure:
        page = None if terminal else (host, port)
        history = _measure(lab, request, output, model_from, page, seconds, points_only, force)
        if points_only:
            show_measured(output, history, history, as_json)
        return
    if detect:
        check_start(lab.rig, lab.names, lab.lenses, request, "detect")
    with open_cameras(lab, output, seconds) as (opened, status):
        cameras, settings = opened.cameras, opened.settings
        for name in sorted(set(lab.names) - set(lab.lenses)):
            warn(
                f"camera {name} has no calibration, but a replay needs one; write calibration = "
                f'"{name}.yaml" into the rig file'
            )
        if detect:
            pipeline.live(cameras, settings, output, request, "detect", [status], force)
        else:
            pipeline.record(cameras, settings, output, [status], force)


def _measure(
    lab: Lab,
    request: Request,
    output: Path,
    model_from: LogLocation | None,
    page: tuple[str | None, int] | None,
    seconds: float | None,
    points_only: bool,
    force: bool,
) -> list[Measurement]:
    """Record while points are measured; return the measurements.

    Parameters
    ----------
    page : address and port of the measuring page; None: the terminal asks.
    points_only : keep only about 1 s of frames of each point.
    """
    from ipsys_log.live_runs import pipeline

    model = ready_to_measure(lab, request, model_from, page)
    ends = "q" if page is None else "Ctrl-C"
    doing = f"measuring into {output}; {ends} to end" if points_only else None
    with open_cameras(lab, output, seconds, doing, panel=page is not None) as (opened, status):
        cameras, settings = opened.cameras, opened.settings
        scene = live_scene(opened, model)
        sinks: list[Sink] = [status, scene]
        if points_only:
            work: Callable[[], Any] = partial(
                pipeline.measure, cameras, settings, output, request, sinks, force
            )
        else:
            work = partial(pipeline.live, cameras, settings, output, request, "camera-frame", sinks, force)
        if page is None:
            _ask_beside(work, scene, cameras)
        else:
            with serve_live_measuring(scene, *page):
                work()
    return scene.history()


def ready_to_measure(
    lab: Lab, request: Request, model_from: LogLocation | None, page: tuple[str | None, int] | None
) -> Model | None:
    """Check that these cameras can measure points; return the newest model of the other log, if named.

    ``page`` is the address and the port of the measuring page; None: there is no page.
    """
    from ipsys_log.capture.live_plan import check_model, check_start
    from ipsys_log.engine.request import fitted_in
    from ipsys_log.live_runs.survey.entry import check_references
    from ipsys_log.log.dataset import Session

    check_references(lab.rig)
    check_start(lab.rig, lab.names, lab.lenses, request, "camera-frame")
    model = None
    if model_from is not None:
        with Session([model_from]) as other:
            model, _ = fitted_in(other, None)
        check_model(model, lab.names)
    if page is not None:
        from ipsys_log.app.web.server import check_port_free

        check_port_free(*page)
    return model


def live_scene(opened: OpenLab, model: Model | None) -> LiveScene:
    """Make the scene of the live cameras, for measuring."""
    from ipsys_log.live_runs.survey.live import LiveScene

    return LiveScene(opened.rig, model, opened.cameras.states, opened.cameras.save)


@contextmanager
def serve_live_measuring(scene: LiveScene, host: str | None, port: int) -> Iterator[None]:
    """Serve the measuring page of live cameras until the block ends, and print its address."""
    with serve_measuring(scene, host, port) as page:
        say(f"measure at {page.url}")
        yield


def _ask_beside(work: Callable[[], Any], scene: LiveScene, cameras: LiveCameras) -> None:
    """Ask in the terminal while the work runs in a thread, and stop the cameras after that."""
    from ipsys_log.app.cli.dialog import ask_places

    allow_interrupt(SAVED)  # this also ends an open question
    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(work)
        try:
            with suppress(KeyboardInterrupt):
                while not (working.done() or any(view.points for view in scene.views(None))):
                    sleep(_TURN_S)
                sleep(_LOOK_S)
                if not working.done():
                    ask_places(scene)
        finally:
            cameras.stop()
        working.result()


@runs_until_stopped
@takes_streams
def live(
    output: cli.NewLog,
    model_from: Annotated[
        cli.OtherLog,
        other_log_option("--model-from", help="The log with the fitted model to apply, a file or a URL."),
    ] = None,
    rig: cli.RigNow = Path("lab.toml"),
    model: cli.FittedModels = None,
    camera: cli.Only = None,
    calibration: cli.Calibrations = None,
    corners: cli.Corners = None,
    method: cli.Method = "perimeter",
    self_calibrate: cli.SelfCalibrate = False,
    view: View = False,
    web: Web = False,
    web_port: WebPort = None,
    *,
    streams: StreamOptions,
    seconds: cli.Seconds = None,
    force: cli.Force = False,
) -> None:
    """Track robots live: record, and process every frame with all stages up to fuse, until Ctrl-C.

    Examples

        ipsys live --model-from calibration.mcap -o monday.mcap
        ipsys live --model-from calibration.mcap --model best --view -o b.mcap
        ipsys live --model-from calibration.mcap -o monday.mcap --udp 9870
        ipsys live --model-from calibration.mcap -o monday.mcap --web
    """
    allow_interrupt(_NOT_BEGUN)
    from ipsys_log.capture.live_plan import check_start, shown_run
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs import pipeline
    from ipsys_log.sinks.streams.opening import check_streams, open_live_streams

    for option, is_wanted in (("--view", view), ("--rerun", streams["rerun"])):
        if is_wanted:
            check_installed(f"{option} needs", "rerun")
    if web:
        check_installed("--web needs", "starlette", "uvicorn")
    lab = prepare_lab(rig, camera, calibration)
    check_target(output, force, [*lab.files, *([(MODEL, model_from)] if model_from else [])])
    models = tuple(dict.fromkeys(model or ()))
    parameters = {"self_calibrate": "yes"} if self_calibrate else {}
    request = Request(
        models=models, model_from=model_from, corners=corners, method=method, parameters=parameters
    )
    for line in check_start(lab.rig, lab.names, lab.lenses, request, None):
        warn(line)
    planned = plan_dashboard(web, streams["host"], web_port, request)
    streamed = choose_streams(lab.rig, rig.parent, has_page=web, **streams)
    for line in check_streams(streamed):
        say(line)
    if streamed and not lab.rig.robot_heights_m():
        text = f"{rig}: names no robots; the streams name them marker_<id>. Add robot = NAME to [[markers]]"
        warn(text)
    run = shown_run(request)
    with (
        open_cameras(lab, output, seconds) as (opened, status),
        open_live_streams(streamed, opened, run) as senders,
        _viewers(opened, run, streamed, view) as viewers,
        serve_dashboard(planned, opened, status, output, run, senders) as dashboards,
    ):
        sinks: list[Sink] = [status, *viewers, *dashboards, *senders]
        pipeline.live(opened.cameras, opened.settings, output, request, None, sinks, force)


@contextmanager
def _viewers(
    opened: OpenLab, run: str, streamed: StreamSettings, has_window: bool
) -> Iterator[list[LiveView]]:
    """Show the recording in a window, and on a page for a browser of this machine, as the user asked."""
    if not (has_window or streamed.rerun):
        yield []
        return
    from ipsys_log.sinks.rerun.viewer import LiveView, ViewerPage

    cameras = opened.cameras.states
    views = [LiveView(opened.rig, cameras, run, say)] if has_window else []
    with ExitStack() as stack:
        if streamed.rerun:
            page = stack.enter_context(closing(ViewerPage()))
            say(page.describe())
            shown = cameras if streamed.images else ()
            views.append(LiveView(opened.rig, shown, run, say, page.show, page.name))
        yield views
