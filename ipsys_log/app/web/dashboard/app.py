"""The dashboards of a live recording and of a played log, and the app that serves one."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from ipsys_log.app.web.dashboard.feed import Feed
from ipsys_log.app.web.dashboard.operator import Operator
from ipsys_log.app.web.dashboard.pictures import shrink
from ipsys_log.app.web.dashboard.state import Dashboard, DashboardSetting, PlayedLog
from ipsys_log.app.web.requests import (
    ERROR_HANDLERS,
    MAY_WRITE,
    OperatorSeat,
    answer_claim,
    answer_file,
    operator_of,
    read_json,
    whole_number,
)
from ipsys_log.capture.lab import OpenLab
from ipsys_log.capture.live_check import FrameCheck
from ipsys_log.errors import FrameError, IpsysError
from ipsys_log.live_runs.player import Player
from ipsys_log.messages import Model
from ipsys_log.sinks.selection import PlayedScene
from ipsys_log.sinks.streams.settings import Stream

_OWN = "ipsys_log.app.web.dashboard"
_SCRIPTS = ("dashboard", "map", "tiles", "tables", "panels", "cameras_panel", "operate")
_FILES = {
    "/": ("dashboard.html", "text/html", _OWN),
    "/dashboard.css": ("dashboard.css", "text/css", _OWN),
    "/theme.css": ("theme.css", "text/css"),
    **{f"/{name}.js": (f"{name}.js", "text/javascript") for name in ("make", "operator")},
    **{f"/{name}.js": (f"{name}.js", "text/javascript", _OWN) for name in _SCRIPTS},
}
# Encoded pictures for later requests of other pages.
_KEPT = 30


def build_dashboard(dashboard: Dashboard, setup: str | None = None) -> Starlette:
    """Return the page of a recording, without a guard.

    The guard marks the requests of devices that may write. Without a guard, all requests may write.

    Parameters
    ----------
    setup : the address of the setup page that shows this page; None: there is none.
    """
    answers = _Answers(dashboard, setup)
    return Starlette(
        routes=[
            *(Route(path, answer_file(*names)) for path, names in _FILES.items()),
            Route("/picture/{camera}/{time_ns}", answers.picture),
            Route("/api/scene", answers.scene),
            Route("/api/live", answers.live),
            Route("/api/operate", answers.operate, methods=["POST"]),
            Route("/api/mark", answers.mark, methods=["POST"]),
            Route("/api/segment", answers.segment, methods=["POST"]),
        ],
        exception_handlers=ERROR_HANDLERS,
    )


class _Answers:
    """The handlers of the requests; all run in the thread of the server."""

    def __init__(self, dashboard: Dashboard, setup: str | None) -> None:
        self._dashboard, self._feed, self._setup = dashboard, Feed(dashboard), setup
        self._pictures: dict[tuple[str, int], bytes | None] = {}

    async def scene(self, request: Request) -> Response:
        scene = self._dashboard.scene(request.scope.get(MAY_WRITE, True))
        return JSONResponse({**scene, "setup": self._setup})

    async def live(self, _: Request) -> Response:
        events = self._feed.stream(asyncio.get_running_loop().time, asyncio.sleep)
        return StreamingResponse(events, media_type="text/event-stream")

    async def picture(self, request: Request) -> Response:
        camera, time_ns = request.path_params["camera"], whole_number(request.path_params["time_ns"])
        if time_ns is None:
            return Response(status_code=404)
        jpeg = self._encoded(camera, time_ns)
        if jpeg is None:
            return Response(status_code=204)  # a slow page requests a picture that is not kept any more
        # The address always means the same image.
        return Response(jpeg, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=60"})

    async def operate(self, request: Request) -> Response:
        """Claim the operation for a device, or release it."""
        body = await read_json(request)
        return JSONResponse(answer_claim(self._operator().seat, body))

    async def mark(self, request: Request) -> Response:
        body = await read_json(request)
        self._operator().mark(operator_of(body), str(body.get("text", "")))
        return JSONResponse({})

    async def segment(self, request: Request) -> Response:
        """Start a segment by its name, or end the present one."""
        body = await read_json(request)
        operator, number = self._operator(), operator_of(body)
        if "start" in body:
            operator.start_segment(number, str(body["start"]))
        else:
            operator.end_segment(number)
        return JSONResponse({})

    def _operator(self) -> Operator:
        if self._dashboard.operator is None:
            raise IpsysError("this page only shows a log; nothing is recorded")
        return self._dashboard.operator

    def _encoded(self, camera: str, time_ns: int) -> bytes | None:
        """Return the JPEG of a tile, encoded at the first request; None if it is damaged or too old."""
        key = camera, time_ns
        if key not in self._pictures:
            frame = self._dashboard.frame(camera, time_ns)
            if frame is None:
                return None
            try:
                self._pictures[key] = shrink(frame)
            except FrameError:
                self._pictures[key] = None
            while len(self._pictures) > _KEPT:
                del self._pictures[next(iter(self._pictures))]
        return self._pictures[key]


def dashboard_of_recording(
    opened: OpenLab,
    checks: Mapping[str, FrameCheck],
    log: Path,
    model: Model,
    run: str,
    streams: Sequence[Stream],
    seat: OperatorSeat | None = None,
) -> Dashboard:
    """Return the dashboard of a live recording, with an operator.

    Parameters
    ----------
    opened : the open cameras.
    checks : last checks of the cameras, by name.
    log, model, run : the log that is written, the fitted model, and the run of its tracks.
    streams : the streams of positions.
    seat : the seat of the device that operates, if another page has it, too.

    Raises
    ------
    IpsysError
        The model or the intrinsics of a camera are not valid.
    """
    cameras, now_ns = opened.cameras, opened.cameras.clock.now_ns
    setting = DashboardSetting(
        opened.rig, opened.lenses, model, run, cameras.states, checks, log, now_ns, streams
    )
    return Dashboard(setting, Operator(cameras.add, now_ns, cameras.say, seat))


def dashboard_of_player(player: Player, scene: PlayedScene) -> Dashboard:
    """Return the dashboard of a played log. It has no operator: a log is not changed.

    Raises
    ------
    IpsysError
        The model or the intrinsics of a camera are not valid.
    """
    played = PlayedLog(player, scene)
    rig, lenses, model, run = scene.rig, scene.lenses, scene.model, scene.run
    log = Path(scene.name)
    setting = DashboardSetting(
        rig, lenses, model, run, played.states, {}, log, player.now_ns, player.streams, played
    )
    return Dashboard(setting)
