"""The dashboard beside a live recording: ``ipsys live --web``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.measure_live import say_faults

if TYPE_CHECKING:
    from ipsys_log.capture.multiplexer import LiveCameras
    from ipsys_log.messages import Message, Model
    from ipsys_log.report.cameras import LiveStatus
    from ipsys_log.runs.options import Request
    from ipsys_log.sinks.sink import Sink
    from ipsys_log.web.dashboard.state import Dashboard
    from ipsys_log.web.server import PageServer

__all__ = ["DashboardPlan", "first_run", "plan_dashboard", "serve_dashboard"]

_USUAL_PORT = 8000
_GAP = 4


class DashboardPlan(NamedTuple):
    """A dashboard that a command will serve: its address, and the fitted model."""

    host: str | None
    port: int
    model: Model


def plan_dashboard(
    is_wanted: bool, host: str | None, port: int | None, request: Request
) -> DashboardPlan | None:
    """Check that a dashboard can be served, before a camera is opened; None without a dashboard.

    All modules are loaded here: no frame must wait for them.

    Raises
    ------
    IpsysError
        The port is in use, or an option has no effect.
    """
    from ipsys_log.errors import IpsysError

    if not is_wanted:
        if port is not None:
            raise IpsysError("--web-port: has no effect without --web; add --web")
        return None
    import ipsys_log.web.dashboard.app  # noqa: F401
    from ipsys_log.runs.graph import copy_model
    from ipsys_log.runs.select import wanted_models
    from ipsys_log.web.server import check_port_free

    port = _USUAL_PORT if port is None else port
    check_port_free(host, port, "--web-port")
    first, *_ = wanted_models(request)
    return DashboardPlan(host, port, copy_model(request, first)[1])


def first_run(request: Request) -> str:
    """Return the run of the first model: streams, the viewer and the dashboard show one run."""
    from ipsys_log.runs.select import wanted_models
    from ipsys_log.stages.fit import model_run

    first, *_ = wanted_models(request)
    return model_run(first)


@contextmanager
def serve_dashboard(
    plan: DashboardPlan | None,
    opened: tuple[LiveCameras, list[Message], LiveStatus],
    log: Path,
    run: str,
    streams: Sequence[Sink],
) -> Iterator[list[Dashboard]]:
    """Serve the dashboard of a live recording until the end of the block, and print its address.

    Parameters
    ----------
    plan : None: there is no dashboard.
    opened : the cameras, the first messages of the log, and the status on the screen.
    log, run, streams : the log that is written, the run of the shown tracks, and the streams of positions.
    """
    if plan is None:
        yield []
        return
    from ipsys_log.web.dashboard.app import build_dashboard
    from ipsys_log.web.server import serve_app

    dashboard = _dashboard(plan.model, opened, log, run, streams)
    app = build_dashboard(dashboard)
    with serve_app(app, plan.host, plan.port, has_viewers=True, option="--web-port") as page:
        _print_addresses(page)
        try:
            yield [dashboard]
        finally:
            say_faults(page, "the dashboard")


def _dashboard(
    model: Model,
    opened: tuple[LiveCameras, list[Message], LiveStatus],
    log: Path,
    run: str,
    streams: Sequence[Sink],
) -> Dashboard:
    from ipsys_log.messages import CameraCalibration, Rig
    from ipsys_log.web.dashboard.operator import Operator
    from ipsys_log.web.dashboard.state import Dashboard, LiveSetting

    cameras, settings, status = opened
    (rig,) = (message.payload for message in settings if isinstance(message.payload, Rig))
    setting = LiveSetting(
        rig,
        {str(row.camera): row.payload for row in settings if isinstance(row.payload, CameraCalibration)},
        model,
        run,
        cameras.states,
        status.checks,
        log,
        cameras.clock.now_ns,
        streams,
    )
    return Dashboard(setting, Operator(cameras.add, cameras.clock.now_ns, cameras.say))


def _print_addresses(page: PageServer) -> None:
    """Print the address of the page; with a secret, one address to view and one to operate."""
    if page.view_url is None:
        remarks.print(f"dashboard at {page.url}", markup=False)
        return
    from ipsys_log.web.server import qr_code

    codes = [
        [*qr_code(url).splitlines(), name] for url, name in ((page.view_url, "view"), (page.url, "operate"))
    ]
    width = max(map(len, codes[0])) + _GAP
    rows = [f"{left:<{width}}{right}" for left, right in zip(*codes, strict=False)]
    if len(codes[0]) != len(codes[1]) or 2 * width > console.width:
        rows = [*codes[0], *codes[1]]  # one above the other
    for row in rows:
        console.print(row, style="#ffffff on #000000", markup=False)
    remarks.print(f"dashboard, to view:    {page.view_url}", markup=False)
    remarks.print(f"dashboard, to operate: {page.url}", markup=False)
