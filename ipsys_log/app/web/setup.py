"""The app of the setup page: its files, its state, its actions, and the pages of measuring and tracking."""

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Receive, Scope, Send

from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.first_day.session import Pages, SetupSession
from ipsys_log.app.first_day.work import LiveRecording
from ipsys_log.app.web import requests
from ipsys_log.app.web.app import build_app
from ipsys_log.app.web.dashboard.app import build_dashboard, dashboard_of_recording
from ipsys_log.app.web.dashboard.state import Dashboard
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.statistics.calibration_points import active_measurements

Body = Mapping[str, Any]

_SCRIPTS = ("setup", "panels", "fields", "pictures")


class _Embedded:
    """A page below a path of the server, as long as its job works; without one, the path leads back.

    ``scene`` is that of a measuring page.
    """

    def __init__(self) -> None:
        self.app: ASGIApp | None = None
        self.scene: LiveScene | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        app: ASGIApp = RedirectResponse("/", 303) if self.app is None else self.app
        await app(scope, receive, send)

    @contextmanager
    def show(self, app: ASGIApp, scene: LiveScene | None = None) -> Iterator[None]:
        """Show a page until the end of the block."""
        self.app, self.scene = app, scene
        try:
            yield
        finally:
            self.app = self.scene = None


class SetupApp:
    """The setup page of a folder, without a guard.

    Attributes
    ----------
    app : the page.
    session : the setup behind it; close it at the end.
    """

    def __init__(self, folder: LabFolder) -> None:
        self._measuring, self._dashboard = _Embedded(), _Embedded()
        self._seat = requests.OperatorSeat()
        self.session = SetupSession(folder, Pages(self._show_measuring, self._show_dashboard))
        self.app = Starlette(
            routes=[
                *requests.file_routes("setup", _SCRIPTS, "first_day", ("make", "operator")),
                Route("/picture/{kind}/{name}", self._picture),
                Route("/print/{name}.pdf", self._print),
                Route("/api/state", self._state),
                Route("/api/operate", self._operate, methods=["POST"]),
                *self._changes(),
                Mount("/measure", self._measuring),
                Mount("/live", self._dashboard),
            ],
            exception_handlers=requests.ERROR_HANDLERS,
        )

    @contextmanager
    def _show_measuring(self, scene: LiveScene) -> Iterator[None]:
        with self._measuring.show(build_app(scene, setup="../#points"), scene):
            yield

    @contextmanager
    def _show_dashboard(self, view: LiveRecording) -> Iterator[Dashboard]:
        dashboard = dashboard_of_recording(
            view.opened, view.monitor.checks, view.log, view.model, view.run, view.streams, self._seat
        )
        with self._dashboard.show(build_dashboard(dashboard, setup="../#live")):
            yield dashboard

    async def _state(self, request: Request) -> Response:
        # The logs of the folder may be long: another thread reads them.
        state = await asyncio.to_thread(self.session.describe)
        pages = {"measure": self._measuring.app is not None, "live": self._dashboard.app is not None}
        may = request.scope.get(requests.MAY_WRITE, True)
        scene = self._measuring.scene
        count = None if scene is None else len(active_measurements(scene.history()))
        return JSONResponse(
            {
                **state,
                "pages": pages,
                "measured_now": count,
                "may_operate": may,
                "operator": self._seat.number,
            }
        )

    async def _picture(self, request: Request) -> Response:
        data = self.session.picture(request.path_params["kind"], request.path_params["name"])
        if data is None:
            return Response(status_code=404)
        kind = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
        return Response(data, media_type=kind)

    async def _print(self, request: Request) -> Response:
        name = request.path_params["name"]
        data = await asyncio.to_thread(self.session.print_pdf, name, dict(request.query_params))
        headers = {"Content-Disposition": f'attachment; filename="{name}.pdf"'}
        return Response(data, media_type="application/pdf", headers=headers)

    async def _operate(self, request: Request) -> Response:
        """Claim the setup for a device, or release it."""
        return JSONResponse(requests.answer_claim(self._seat, await requests.read_json(request)))

    def _change(self, path: str, act: Callable[[Body], Sequence[Fault] | None]) -> Route:
        """Return the route of a change, which only the operator may make; its work is in another thread."""

        async def answer(request: Request) -> Response:
            body = await requests.read_json(request)
            self._seat.check(requests.operator_of(body))
            faults = await asyncio.to_thread(act, body)
            if not faults:
                return JSONResponse({})
            return JSONResponse({"faults": [fault._asdict() for fault in faults]}, 409)

        return Route(path, answer, methods=["POST"])

    def _changes(self) -> list[Route]:
        session = self.session
        changes: dict[str, Callable[[Body], Sequence[Fault] | None]] = {
            "rig": lambda body: session.save_rig(_texts(body, "values")),
            "simulate": lambda _: session.simulate(),
            "cameras": lambda body: session.save_cameras(_texts(body, "names")),
            "address": lambda body: session.add_camera(_texts(body, "values")),
            "intrinsics": lambda body: session.use_intrinsics(str(body.get("camera", ""))),
            "calibrate": lambda body: session.calibrate(str(body.get("camera", "")), _texts(body, "options")),
            "exclude": lambda body: session.exclude(str(body.get("log", "")), str(body.get("point", ""))),
            "start": lambda body: session.start(str(body.get("action", ""))),
            "stop": lambda _: session.jobs.stop(),
        }
        return [self._change(f"/api/{name}", act) for name, act in changes.items()]


def _texts(body: Mapping[str, Any], key: str) -> dict[str, str]:
    """Return an object of texts in a request; another value is an error."""
    value = body.get(key)
    if not isinstance(value, dict):
        raise IpsysError(f"{key} must be an object of texts; reload this page")
    return {str(name): str(text) for name, text in value.items()}
