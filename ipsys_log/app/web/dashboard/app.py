"""The dashboards of a live recording and of a played log, and the app that serves one with its events."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from ipsys_log.app.web import requests
from ipsys_log.app.web.dashboard.operator import Operator
from ipsys_log.app.web.dashboard.pictures import shrink
from ipsys_log.app.web.dashboard.state import Dashboard, DashboardSetting, PlayedLog
from ipsys_log.capture.lab import OpenLab
from ipsys_log.capture.live_check import FrameCheck
from ipsys_log.errors import FrameError, IpsysError
from ipsys_log.live_runs.player import Player
from ipsys_log.messages import Model
from ipsys_log.sinks.selection import PlayedScene
from ipsys_log.sinks.streams.opening import Stream

# A page gets at most 30 updates per second. All pages wake at the same times: an update is made once.
_TICK_S = 1 / 30
# Shortest time between two versions of a part. The status is made again after a second even without news.
# A wake-up is never exact, so these times are half a tick shorter than their number of ticks.
_ROBOTS_S, _TILES_S, _URGENT_S, _STATUS_S = 0.5 * _TICK_S, 2.5 * _TICK_S, 2.5 * _TICK_S, 1.0
# A stream ends after this time, and the page asks for the next one. So the limit of an answer holds for it,
# too, and a page that does not read is disconnected.
_STREAM_S, _RETRY_MS = 15.0, 200


@dataclass(slots=True)
class _Part:
    """A part of the data: its newest event, its number, and the time and the version of its making."""

    name: str
    make: Callable[[], Any]
    every_s: float
    always_s: float = float("inf")
    number: int = 0
    event: bytes = b""
    made_s: float = float("-inf")
    version: Hashable = None

    def renew(self, now_s: float, version: Hashable) -> None:
        """Make the event again if its version changed, or after ``always_s``."""
        age_s = now_s - self.made_s
        if age_s < self.every_s or (version == self.version and age_s < self.always_s):
            return
        text = json.dumps(self.make(), separators=(",", ":"), allow_nan=False)
        self.event = f"event: {self.name}\ndata: {text}\n\n".encode()
        self.number, self.made_s, self.version = self.number + 1, now_s, version


class Feed:
    """The server-sent events of a dashboard. For one thread."""

    def __init__(self, dashboard: Dashboard) -> None:
        self._dashboard = dashboard
        # In the order of the versions of the dashboard.
        self._parts = (
            _Part("robots", dashboard.robots, _ROBOTS_S),
            _Part("tiles", dashboard.tiles, _TILES_S),
            _Part("status", dashboard.status, _URGENT_S, _STATUS_S),
        )

    def newest(self, sent: dict[str, int], now_s: float) -> bytes:
        """Return the events that a page does not have, and note them in ``sent``."""
        for part, version in zip(self._parts, self._dashboard.versions(), strict=True):
            part.renew(now_s, version)
        news = [part for part in self._parts if sent.get(part.name) != part.number]
        sent.update({part.name: part.number for part in news})
        return b"".join(part.event for part in news)

    async def stream(self, now_s: Callable[[], float], sleep: Callable[[float], Any]) -> AsyncIterator[bytes]:
        """Yield events for one page, for a limited time. A page that reads slowly misses the older ones.

        Parameters
        ----------
        now_s : the clock of the event loop.
        sleep : waits without blocking the loop.
        """
        sent: dict[str, int] = {}
        end_s = now_s() + _STREAM_S
        yield f"retry: {_RETRY_MS}\n\n".encode()
        while now_s() < end_s:
            events = self.newest(sent, now_s())
            if events:
                yield events
            if self._dashboard.end is not None and self._is_complete(sent):
                return
            # A sleep of a whole tick would add the time of the work and of the wake-up to each tick.
            await sleep(_TICK_S - now_s() % _TICK_S)

    def _is_complete(self, sent: dict[str, int]) -> bool:
        """Return whether a page has the newest version of each part."""
        versions = self._dashboard.versions()
        return all(
            part.version == version and sent.get(part.name) == part.number
            for part, version in zip(self._parts, versions, strict=True)
        )


_SCRIPTS = ("dashboard", "map", "tiles", "tables", "panels", "cameras_panel", "operate")
# Encoded pictures for later requests of other pages.
_KEPT = 30


def build_dashboard(dashboard: Dashboard, setup: str | None = None) -> Starlette:
    """Return the page of a recording, without a guard.

    The guard marks the requests of devices that may write. Without a guard, all requests may write.

    ``setup`` is the address of the setup page that shows this page; None: there is none.
    """
    answers = _Answers(dashboard, setup)
    return Starlette(
        routes=[
            *requests.file_routes("dashboard", _SCRIPTS, "dashboard", ("make", "operator")),
            Route("/picture/{camera}/{time_ns}", answers.picture),
            Route("/api/scene", answers.scene),
            Route("/api/live", answers.live),
            Route("/api/operate", answers.operate, methods=["POST"]),
            Route("/api/mark", answers.mark, methods=["POST"]),
            Route("/api/segment", answers.segment, methods=["POST"]),
            Route("/api/play", answers.play, methods=["POST"]),
        ],
        exception_handlers=requests.ERROR_HANDLERS,
    )


class _Answers:
    """The handlers of the requests; all run in the thread of the server."""

    def __init__(self, dashboard: Dashboard, setup: str | None) -> None:
        self._dashboard, self._feed, self._setup = dashboard, Feed(dashboard), setup
        self._pictures: dict[tuple[str, int], bytes | None] = {}

    async def scene(self, request: Request) -> Response:
        scene = self._dashboard.scene(request.scope.get(requests.MAY_WRITE, True))
        return JSONResponse({**scene, "setup": self._setup})

    async def live(self, _: Request) -> Response:
        events = self._feed.stream(asyncio.get_running_loop().time, asyncio.sleep)
        return StreamingResponse(events, media_type="text/event-stream")

    async def picture(self, request: Request) -> Response:
        camera, time_ns = request.path_params["camera"], requests.whole_number(request.path_params["time_ns"])
        if time_ns is None:
            return Response(status_code=404)
        jpeg = self._encoded(camera, time_ns)
        if jpeg is None:
            return Response(status_code=204)  # a slow page requests a picture that is not kept any more
        # The address always means the same image.
        return Response(jpeg, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=60"})

    async def operate(self, request: Request) -> Response:
        """Claim the operation for a device, or release it."""
        body = await requests.read_json(request)
        return JSONResponse(requests.answer_claim(self._operator().seat, body))

    async def mark(self, request: Request) -> Response:
        body = await requests.read_json(request)
        self._operator().mark(requests.operator_of(body), str(body.get("text", "")))
        return JSONResponse({})

    async def segment(self, request: Request) -> Response:
        """Start a segment by its name, or end the present one."""
        body = await requests.read_json(request)
        operator, number = self._operator(), requests.operator_of(body)
        if "start" in body:
            operator.start_segment(number, str(body["start"]))
        else:
            operator.end_segment(number)
        return JSONResponse({})

    async def play(self, request: Request) -> Response:
        """Change the playback of a log; return its new state."""
        return JSONResponse(self._dashboard.control(await requests.read_json(request)))

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
    seat: requests.OperatorSeat | None = None,
) -> Dashboard:
    """Return the dashboard of a live recording, with an operator.

    Parameters
    ----------
    log, run : the log that is written, and the run of the shown tracks.
    seat : the seat of the device that operates, if another page has it, too.
    """
    cameras, now_ns = opened.cameras, opened.cameras.clock.now_ns
    lab = opened.rig, opened.lenses, model, run
    setting = DashboardSetting(
        *lab, cameras.states, checks, log, now_ns, streams, positions=cameras.positions
    )
    return Dashboard(setting, Operator(cameras.add, now_ns, cameras.say, seat))


def dashboard_of_player(player: Player, scene: PlayedScene) -> Dashboard:
    """Return the dashboard of a played log. It has a player and no operator: a log is not changed."""
    played = PlayedLog(player, scene)
    rig, lenses, model, run = scene.rig, scene.lenses, scene.model, scene.run
    log = Path(scene.name)
    setting = DashboardSetting(
        rig, lenses, model, run, played.states, {}, log, player.now_ns, player.streams, played
    )
    return Dashboard(setting)
