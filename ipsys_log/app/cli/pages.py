"""Pages that a command serves: measuring, and the dashboard beside a recording or a playback."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from ipsys_log.app.cli.console import console, remarks, say
from ipsys_log.app.cli.options import setting, switch
from ipsys_log.errors import IpsysError

if TYPE_CHECKING:
    from ipsys_log.app.report.cameras import LiveStatus
    from ipsys_log.app.web.dashboard.state import Dashboard
    from ipsys_log.app.web.server import PageServer
    from ipsys_log.capture.lab import OpenLab
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.player import Player
    from ipsys_log.live_runs.survey.scene import MeasuringScene
    from ipsys_log.messages import Model
    from ipsys_log.sinks.streams.opening import Stream

_USUAL_PORT = 8000
_GAP = 4
_CODE_STYLE = "#ffffff on #000000"

Web = Annotated[bool, switch("--web", "Show a page, the dashboard, for any number of browsers.")]
WebPort = Annotated[
    int | None,
    setting(
        "--web-port",
        "PORT",
        "Serve the dashboard on this port instead of 8000; 0 for any free port.",
        min=0,
        max=65535,
    ),
]


def print_code(url: str, is_open: bool) -> None:
    """Print the address as a code for a phone, if the page is open to the network."""
    from ipsys_log.app.web.server import qr_code

    if is_open:
        console.print(qr_code(url), style=_CODE_STYLE)


def say_faults(page: PageServer, name: str = "the measuring page") -> None:
    """Print the faults of the page's server at the end, when the screen is free for a traceback."""
    if page.exceptions.count:
        remarks.print(f"internal errors of {name}: {page.exceptions.count}; the first one:", style="red")
        say(page.exceptions.first)


@contextmanager
def serve_measuring(scene: MeasuringScene, host: str | None, port: int) -> Iterator[PageServer]:
    """Serve the measuring page until the block ends."""
    from ipsys_log.app.web.app import build_app
    from ipsys_log.app.web.server import serve_app

    with serve_app(build_app(scene), host, port) as page:
        print_code(page.url, host is not None)
        try:
            yield page
        finally:
            say_faults(page)


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
    """
    port = check_dashboard(is_wanted, host, port)
    if not is_wanted:
        return None
    import ipsys_log.app.web.dashboard.app  # noqa: F401
    from ipsys_log.engine.graph import copy_model
    from ipsys_log.engine.model_choice import applied_models

    first, *_ = applied_models(request)[0]
    return DashboardPlan(host, port, copy_model(request, first)[1])


@contextmanager
def serve_dashboard(
    plan: DashboardPlan | None,
    opened: OpenLab,
    status: LiveStatus,
    log: Path,
    run: str,
    streams: Sequence[Stream],
) -> Iterator[list[Dashboard]]:
    """Serve the dashboard of a live recording until the end of the block, and print its address.

    Without a plan, there is no dashboard.
    """
    if plan is None:
        yield []
        return
    from ipsys_log.app.web.dashboard.app import dashboard_of_recording

    dashboard = dashboard_of_recording(opened, status.checks, log, plan.model, run, streams)
    with _serve(dashboard, plan.host, plan.port):
        yield [dashboard]


def check_dashboard(is_wanted: bool, host: str | None, port: int | None) -> int:
    """Check that a dashboard can be served, and that its option has an effect; return its port."""
    if port is not None and not is_wanted:
        raise IpsysError("--web-port: has no effect without --web; add --web")
    port = _USUAL_PORT if port is None else port
    if is_wanted:
        from ipsys_log.app.web.server import check_port_free

        check_port_free(host, port, "--web-port")
    return port


@contextmanager
def serve_playback(player: Player, host: str | None, port: int) -> Iterator[None]:
    """Serve the dashboard of a player until the end of the block, and print its address.

    Without a dashboard, the player has no scene, and nothing is served.
    """
    if player.scene is None:
        yield
        return
    from ipsys_log.app.web.dashboard.app import dashboard_of_player

    dashboard = dashboard_of_player(player, player.scene)
    player.show_on(dashboard)
    with _serve(dashboard, host, port):
        yield


@contextmanager
def _serve(dashboard: Dashboard, host: str | None, port: int) -> Iterator[None]:
    from ipsys_log.app.web.dashboard.app import build_dashboard
    from ipsys_log.app.web.server import serve_app

    app = build_dashboard(dashboard)
    with serve_app(app, host, port, has_viewers=True, option="--web-port") as page:
        _print_addresses(page, is_secret=host is not None)
        try:
            yield
        finally:
            say_faults(page, "the dashboard")


def _print_addresses(page: PageServer, is_secret: bool) -> None:
    """Print the address of the page; with secrets, one to view and one to operate."""
    from ipsys_log.app.web.server import qr_code

    if page.view_url is None:
        print_code(page.url, is_secret)
        say(f"dashboard at {page.url}")
        return
    codes = [
        [*qr_code(url).splitlines(), name] for url, name in ((page.view_url, "view"), (page.url, "operate"))
    ]
    width = max(map(len, codes[0])) + _GAP
    rows = [f"{left:<{width}}{right}" for left, right in zip(*codes, strict=False)]
    if len(codes[0]) != len(codes[1]) or 2 * width > console.width:
        rows = [*codes[0], *codes[1]]  # one above the other
    for row in rows:
        console.print(row, style=_CODE_STYLE)
    say(f"dashboard, to view:    {page.view_url}")
    say(f"dashboard, to operate: {page.url}")
