"""Measurements with live cameras: the page or the terminal beside the pipeline."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Any

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.open_cameras import MODEL, Lab, check_target, open_cameras, prepare_lab
from ipsys_log.cli.signals import allow_interrupt

if TYPE_CHECKING:
    from ipsys_log.capture.multiplexer import LiveCameras
    from ipsys_log.log.location import LogLocation
    from ipsys_log.messages import Measurement, Message, Model
    from ipsys_log.runs.options import Request
    from ipsys_log.survey.live import LiveScene
    from ipsys_log.web.server import PageServer

_TURN_S = 0.05
# After this time, the markers in the images and their stationary intervals are known.
_LOOK_S = 1.0


def measure_now(
    output: Path,
    rig: Path,
    camera: list[str] | None,
    calibration: list[str] | None,
    corners: str | None,
    model_from: LogLocation | None,
    force: bool,
    terminal: bool,
    host: str | None,
    port: int,
) -> list[Measurement]:
    """Measure points into a new log, each with a second of frames; return the measurements."""
    from ipsys_log import pipeline
    from ipsys_log.runs.options import Request
    from ipsys_log.sinks.sink import Consumer

    lab, request = prepare_lab(rig, camera, calibration), Request(corners=corners)
    read = lab.files if model_from is None else [*lab.files, (MODEL, model_from)]
    check_target(output, force, read)
    model = ready_to_measure(lab, request, model_from)
    if not terminal:
        from ipsys_log.web.server import check_port_free

        check_port_free(host, port)
    ends = "q" if terminal else "Ctrl-C"
    doing = f"measuring into {output}; {ends} to end"
    with open_cameras(lab, output, None, doing, not terminal) as (cameras, settings, status):
        scene = live_scene(settings, cameras, model)
        consumers: list[Consumer] = [status, scene]
        work = partial(pipeline.measure, cameras, settings, output, request, consumers, force)
        if terminal:
            _ask_beside(work, scene, cameras)
        else:
            with serve_live_page(scene, host, port):
                work()
    return scene.history()


def ready_to_measure(lab: Lab, request: Request, model_from: LogLocation | None) -> Model | None:
    """Check that these cameras can measure points; return the newest model of the other log, if named."""
    import ipsys_log.models.poly  # noqa: F401 - the outliers need it, and no frame must wait for it
    from ipsys_log.capture.live_plan import check_model, check_start
    from ipsys_log.log.dataset import Session
    from ipsys_log.runs.select import fitted_in
    from ipsys_log.survey.entry import check_references

    check_references(lab.rig)
    check_start(lab.rig, lab.names, lab.lenses, request, "camera-frame")
    if model_from is None:
        return None
    with Session([model_from]) as other:
        model, _ = fitted_in(other, None)
    check_model(model, lab.names)
    return model


def live_scene(settings: list[Message], cameras: LiveCameras, model: Model | None) -> LiveScene:
    """Make the scene of the live cameras, for measuring."""
    from ipsys_log.survey.live import LiveScene

    return LiveScene(settings[0].payload, model, cameras.states, cameras.save)


@contextmanager
def serve_live_page(scene: LiveScene, host: str | None, port: int) -> Iterator[None]:
    """Serve the measuring page until the block ends."""
    from ipsys_log.web.server import qr_code, serve

    with serve(scene, host, port) as page:
        if host is not None:
            console.print(qr_code(page.url), style="#ffffff on #000000", markup=False)
        remarks.print(f"measure at {page.url}", markup=False)
        try:
            yield
        finally:
            say_faults(page)


def say_faults(page: PageServer, name: str = "the measuring page") -> None:
    """Print the faults of the page's server at the end, when the screen is free for a traceback."""
    if page.exceptions.count:
        remarks.print(f"internal errors of {name}: {page.exceptions.count}; the first one:", style="red")
        remarks.print(page.exceptions.first, markup=False, highlight=False)


def _ask_beside(work: Callable[[], Any], scene: LiveScene, cameras: LiveCameras) -> None:
    """Ask in the terminal while the work runs in a thread, and stop the cameras after that."""
    from ipsys_log.cli.dialog import ask_places

    allow_interrupt("stopped; every saved point is in the log")  # this also ends an open question
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
