"""The app of the setup page: its files, its state, its actions, and the pages of measuring and tracking."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Receive, Scope, Send

from ipsys_log.errors import IpsysError
from ipsys_log.first_day.lab_folder import LabFolder
from ipsys_log.first_day.session import Pages, SetupSession
from ipsys_log.first_day.work import LiveRecording
from ipsys_log.survey.entry import Fault
from ipsys_log.survey.live import LiveScene
from ipsys_log.web.access import MAY_WRITE
from ipsys_log.web.app import build_app
from ipsys_log.web.dashboard.app import build_dashboard
from ipsys_log.web.dashboard.sources import dashboard_of_recording
from ipsys_log.web.dashboard.state import Dashboard
from ipsys_log.web.requests import ERROR_HANDLERS, answer_file, read_json

__all__ = ["SetupApp"]

_OWN = "ipsys_log.web.first_day"
_SCRIPTS = ("setup", "panels", "fields", "pictures")
_FILES = {
    "/": ("setup.html", "text/html", _OWN),
    "/setup.css": ("setup.css", "text/css", _OWN),
    "/theme.css": ("theme.css", "text/css"),
    "/make.js": ("make.js", "text/javascript"),
    **{f"/{name}.js": (f"{name}.js", "text/javascript", _OWN) for name in _SCRIPTS},
}


class _Embedded:
    """A page below a path of the server, as long as its job works; without one, the path leads back."""

    def __init__(self) -> None:
        self.app: ASGIApp | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        app: ASGIApp = RedirectResponse("/", 303) if self.app is None else self.app
        await app(scope, receive, send)

    @contextmanager
    def show(self, app: ASGIApp) -> Iterator[None]:
        """Show a page until the end of the block."""
        self.app = app
        try:
            yield
        finally:
            self.app = None


class SetupApp:
    """The setup page of a folder, without a guard.

    Attributes
    ----------
    app : the page.
    session : the setup behind it; close it at the end.
    """

    def __init__(self, folder: LabFolder) -> None:
        self._measuring, self._dashboard = _Embedded(), _Embedded()
        self.session = SetupSession(folder, Pages(self._show_measuring, self._show_dashboard))
        self.app = Starlette(
            routes=[
                *(Route(path, answer_file(*names)) for path, names in _FILES.items()),
                Route("/picture/{kind}/{name}", self._picture),
                Route("/api/state", self._state),
                Route("/api/rig", self._rig, methods=["POST"]),
                Route("/api/simulate", self._simulate, methods=["POST"]),
                Route("/api/cameras", self._cameras, methods=["POST"]),
                Route("/api/intrinsics", self._intrinsics, methods=["POST"]),
                Route("/api/calibrate", self._calibrate, methods=["POST"]),
                Route("/api/start", self._start, methods=["POST"]),
                Route("/api/stop", self._stop, methods=["POST"]),
                Mount("/measure", self._measuring),
                Mount("/live", self._dashboard),
            ],
            exception_handlers=ERROR_HANDLERS,
        )

    @contextmanager
    def _show_measuring(self, scene: LiveScene) -> Iterator[None]:
        with self._measuring.show(build_app(scene)):
            yield

    @contextmanager
    def _show_dashboard(self, view: LiveRecording) -> Iterator[Dashboard]:
        lab = view.lab
        dashboard = dashboard_of_recording(
            lab.cameras, lab.settings, lab.monitor.checks, view.log, view.model, view.run, view.streams
        )
        with self._dashboard.show(build_dashboard(dashboard)):
            yield dashboard

    async def _state(self, request: Request) -> Response:
        # The logs of the folder may be long: another thread reads them.
        state = await asyncio.to_thread(self.session.describe)
        pages = {"measure": self._measuring.app is not None, "live": self._dashboard.app is not None}
        may = request.scope.get(MAY_WRITE, True)
        return JSONResponse({**state, "pages": pages, "may_operate": may})

    async def _picture(self, request: Request) -> Response:
        data = self.session.picture(request.path_params["kind"], request.path_params["name"])
        if data is None:
            return Response(status_code=404)
        kind = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
        return Response(data, media_type=kind)

    async def _rig(self, request: Request) -> Response:
        typed = _texts(await read_json(request), "values")
        return _answer(await asyncio.to_thread(self.session.save_rig, typed))

    async def _simulate(self, _: Request) -> Response:
        await asyncio.to_thread(self.session.simulate)
        return JSONResponse({})

    async def _cameras(self, request: Request) -> Response:
        names = _texts(await read_json(request), "names")
        return _answer(await asyncio.to_thread(self.session.save_cameras, names))

    async def _intrinsics(self, request: Request) -> Response:
        camera = str((await read_json(request)).get("camera", ""))
        await asyncio.to_thread(self.session.use_intrinsics, camera)
        return JSONResponse({})

    async def _calibrate(self, request: Request) -> Response:
        body = await read_json(request)
        camera, board = str(body.get("camera", "")), str(body.get("board", ""))
        return _answer(await asyncio.to_thread(self.session.calibrate, camera, board))

    async def _start(self, request: Request) -> Response:
        action = str((await read_json(request)).get("action", ""))
        await asyncio.to_thread(self.session.start, action)
        return JSONResponse({})

    async def _stop(self, _: Request) -> Response:
        self.session.jobs.stop()
        return JSONResponse({})


def _texts(body: Mapping[str, Any], key: str) -> dict[str, str]:
    """Return an object of texts in a request.

    Raises
    ------
    IpsysError
        The value is not an object.
    """
    value = body.get(key)
    if not isinstance(value, dict):
        raise IpsysError(f"{key} must be an object of texts; reload this page")
    return {str(name): str(text) for name, text in value.items()}


def _answer(faults: Sequence[Fault]) -> Response:
    """Return an empty answer, or the faults of the fields."""
    if not faults:
        return JSONResponse({})
    return JSONResponse({"faults": [fault._asdict() for fault in faults]}, 409)
