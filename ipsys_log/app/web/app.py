"""The app of the measuring page: it answers the requests, one at a time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from ipsys_log.app.report.styles import camera_styles
from ipsys_log.app.web.requests import ERROR_HANDLERS, MOST_DIGITS, file_routes, read_json, whole_number
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey import checks
from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry
from ipsys_log.live_runs.survey.scene import CameraView, MeasuringScene, observe_marker, visible_markers
from ipsys_log.messages import Measurement
from ipsys_log.statistics.calibration_points import (
    active_baselines,
    active_measurements,
    locate_measurements,
    withdrawals,
)
from ipsys_log.units import CM_PER_M, NS_PER_S
from ipsys_log.vision.trilateration import are_collinear


def scene_json(scene: MeasuringScene) -> dict[str, Any]:
    """Return the constant data of the page: the lab, and the stationary intervals of a log."""
    rig = scene.rig
    points_m = np.array([(p.x_m, p.y_m) for p in rig.reference_points])
    return {
        "lab": rig.name,
        "references": [{"name": p.name, "x_m": p.x_m, "y_m": p.y_m} for p in rig.reference_points],
        "floor": None if rig.floor is None else [rig.floor.width_m, rig.floor.depth_m],
        "one_line": are_collinear(points_m),
        "baseline": {"names": checks.baseline_names(rig), "counts": rig.ab_sigma_m is not None},
        "stops": [
            {"marker": interval.marker_id, "seconds": (interval.end_ns - interval.start_ns) / NS_PER_S}
            for interval in scene.intervals
        ],
        "model": None if scene.model is None else scene.model.name,
    }


def history_json(scene: MeasuringScene) -> dict[str, Any]:
    """Return all measurements so far, newest first, also withdrawn ones; and the measured intervals."""
    history = scene.history()
    active = active_measurements(history)
    withdrawn, baselines = withdrawals(history), active_baselines(history)
    points = {place.id: place.point_m for place in locate_measurements(active, scene.rig)[0]}
    rows = [
        {
            "id": measurement.id,
            "marker": measurement.marker_id,
            "counts": measurement in active or measurement in baselines,
            "point_m": points[measurement.id].tolist()
            if measurement in active and measurement.id in points
            else None,
            "reason": withdrawn[measurement.id].reason if measurement.id in withdrawn else None,
            "tapes": _tapes(measurement),
        }
        for measurement in reversed(history)
        if measurement.refers_to is None
    ]
    measured = [next((m.id for m in active if interval.covers(m)), None) for interval in scene.intervals]
    return {"next": checks.next_id(history), "places": rows, "measured": measured}


def _tapes(measurement: Measurement) -> str:
    tapes = [f"{tape.reference} {tape.distance_m * CM_PER_M:.1f} cm" for tape in measurement.distances]
    side = [measurement.side] if measurement.side else []
    height = [f"height {measurement.height_m * CM_PER_M:.1f} cm"] if measurement.height_m is not None else []
    return ", ".join([*tapes, *side, *height])


# A longer list of ids is not read.
_MOST_NAMED = 8


def views_json(scene: MeasuringScene, views: Sequence[CameraView], marker_id: int | None) -> dict[str, Any]:
    """Return the present views of the cameras, and the observations of the chosen marker.

    Without a chosen marker, a single visible marker is chosen.
    """
    visible = visible_markers(views, scene.rig)
    if marker_id is None and len(visible) == 1:
        marker_id = visible[0]
    observations = None if marker_id is None else observe_marker(views, marker_id)
    colours = camera_styles(view.camera for view in views)
    return {
        "marker": marker_id,
        "visible": visible,
        "measured": _measured_by_camera(scene, views),
        "state": observations.state if observations else "choose" if visible else "unseen",
        "text": _invitation(visible) if observations is None else observations.text,
        "cameras": [
            {
                "name": view.camera,
                "colour": colours[view.camera][0],
                "sees": observations is not None
                and view.camera in (*observations.points_m, *observations.moving),
                "picture": None if view.jpeg is None else f"picture/{view.camera}/{view.time_ns}",
                "size_px": None if view.markers is None else [view.markers.width, view.markers.height],
                "markers": [
                    {"id": marker.id, "corners_px": marker.corners_px.round(1).tolist()}
                    for marker in (view.markers.markers if view.markers else ())
                ],
            }
            for view in views
        ],
    }


def _measured_by_camera(scene: MeasuringScene, views: Sequence[CameraView]) -> dict[str, int]:
    """Return the number of valid points that each camera has seen."""
    active = {measurement.id for measurement in active_measurements(scene.history())}
    return {view.camera: sum(name in active for name, _, _ in view.measured) for view in views}


def _invitation(visible: Sequence[int]) -> str:
    if not visible:
        return "no camera sees a marker: put one on the floor, face up"
    if len(visible) > _MOST_NAMED:
        return f"choose the marker: {len(visible)} are visible; tap it in the image, or choose its id"
    return f"choose the marker: {', '.join(map(str, visible))} are visible"


def checked_json(checked: checks.EntryCheck) -> dict[str, Any]:
    """Return the result of the check of an entry."""
    point = None if checked.point_m is None else checked.point_m.tolist()
    return {
        "id": checked.id,
        "faults": [fault._asdict() for fault in checked.faults],
        "warnings": list(checked.warnings),
        "point_m": point,
        "sigma_cm": None if checked.sigma_m is None else checked.sigma_m * CM_PER_M,
        "residuals": [{"name": name, "cm": off_m * CM_PER_M} for name, off_m in checked.residuals_m],
        "on_floor": checked.on_floor,
        "predictions": [
            {
                "camera": prediction.camera,
                "point_m": prediction.world_m.tolist(),
                "cm": prediction.off_m * CM_PER_M,
            }
            for prediction in checked.predictions
        ],
        "sides": [{"side": side, "point_m": place_m.tolist()} for side, place_m in checked.sides_m],
        "ready": checked.measurement is not None,
    }


# Number of images that are kept for later requests, after the page got their addresses.
_KEPT = 30


def build_app(scene: MeasuringScene, setup: str | None = None) -> Starlette:
    """Return the page of a scene, without a guard; its requests are under ``/api``.

    ``setup`` is the address of the setup page that shows this page; None: there is none.
    """
    questions = _Questions(scene, setup)
    return Starlette(
        routes=[
            *file_routes("measure", ("measure", "cameras", "floor", "make")),
            Route("/picture/{camera}/{time_ns}", questions.picture),
            Route("/api/scene", questions.scene),
            Route("/api/views", questions.views),
            Route("/api/check", questions.check, methods=["POST"]),
            Route("/api/measure", questions.measure, methods=["POST"]),
            Route("/api/baseline", questions.baseline, methods=["POST"]),
            Route("/api/undo", questions.undo, methods=["POST"]),
        ],
        exception_handlers=ERROR_HANDLERS,
    )


class _Questions:
    """The handlers of the requests.

    They are asynchronous, but wait only for the body of a request. So they answer one request at a time.
    """

    def __init__(self, scene: MeasuringScene, setup: str | None) -> None:
        self._scene, self._setup = scene, setup
        self._pictures: dict[tuple[str, int], bytes] = {}

    async def scene(self, _: Request) -> Response:
        scene = scene_json(self._scene)
        return JSONResponse({**scene, "setup": self._setup, "history": history_json(self._scene)})

    async def views(self, request: Request) -> Response:
        views = self._scene.views(self._stop(request.query_params.get("stop")))
        for view in views:
            if view.jpeg is not None:
                self._pictures[view.camera, view.time_ns] = view.jpeg
        while len(self._pictures) > max(_KEPT, 2 * len(views)):
            del self._pictures[next(iter(self._pictures))]
        marker_id = whole_number(request.query_params.get("marker", ""))
        return JSONResponse(views_json(self._scene, views, marker_id))

    async def picture(self, request: Request) -> Response:
        time_ns = whole_number(request.path_params["time_ns"])
        jpeg = None if time_ns is None else self._pictures.get((request.path_params["camera"], time_ns))
        if jpeg is None:
            return Response(status_code=404)
        # The address always means the same image.
        return Response(jpeg, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=60"})

    async def check(self, request: Request) -> Response:
        return JSONResponse(checked_json(self._checked(await read_json(request))))

    async def measure(self, request: Request) -> Response:
        """Append the measurement if it has no faults, and the user has accepted all its warnings."""
        body = await read_json(request)
        checked = self._checked(body)
        accepted = body.get("accepted", [])
        if checked.measurement is None or not set(checked.warnings) <= set(map(str, accepted)):
            return JSONResponse(checked_json(checked), 409)
        self._scene.add([checked.measurement])
        return JSONResponse({"saved": checked.id, "history": history_json(self._scene)})

    async def baseline(self, request: Request) -> Response:
        """Append a reading of the distance between the first two reference points."""
        scene, text = self._scene, str((await read_json(request)).get("distance", ""))
        time_ns = max((view.time_ns for view in scene.views(None)), default=0)
        reading = checks.read_baseline(text, scene.rig, scene.history(), time_ns)
        scene.add([reading])
        return JSONResponse({"saved": reading.id, "history": history_json(scene)})

    async def undo(self, request: Request) -> Response:
        name = str((await read_json(request)).get("id", ""))
        self._scene.add([checks.withdrawal_of(self._scene.history(), name)])
        return JSONResponse({"withdrawn": name, "history": history_json(self._scene)})

    def _checked(self, body: Mapping[str, Any]) -> checks.EntryCheck:
        scene, distances = self._scene, body.get("distances", {})
        if not isinstance(distances, dict):
            raise IpsysError("distances must be an object, by reference point")
        texts = {name: str(body.get(name, "")) for name in ("marker", "side", "height", "split")}
        typed = TypedEntry(distances={str(k): str(v) for k, v in distances.items()}, **texts)
        entry, faults = parse_entry(typed, scene.rig)
        interval = self._stop(body.get("stop"))
        observations = None
        if entry.marker_id is not None:
            observations = observe_marker(scene.views(interval), entry.marker_id)
        return checks.check_entry(entry, faults, scene.rig, observations, scene.history(), scene.model)

    def _stop(self, given: Any) -> int | None:
        if not self._scene.intervals:
            return None
        number = whole_number(str(given))
        if number is None or number >= len(self._scene.intervals):
            raise IpsysError(f"there is no stationary interval {str(given)[:MOST_DIGITS]} in this log")
        return number
