"""What the page is told: lengths in m to be drawn, in cm to be read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ipsys_log.analysis.pairs import active_measurements
from ipsys_log.analysis.places import measured_places
from ipsys_log.geometry.multilateration import sides_alike
from ipsys_log.messages import Measurement
from ipsys_log.report.palette import camera_styles
from ipsys_log.survey.checks import Checked, next_id
from ipsys_log.survey.scene import Scene, Stop, View, look, visible_markers
from ipsys_log.units import CM_PER_M, NS_PER_S

__all__ = ["checked_json", "history_json", "scene_json", "views_json"]


def scene_json(scene: Scene) -> dict[str, Any]:
    """What stays as it is: the lab and the places to go through."""
    rig = scene.rig
    at_m = np.array([(p.x_m, p.y_m) for p in rig.reference_points])
    return {
        "lab": rig.name,
        "references": [{"name": p.name, "x_m": p.x_m, "y_m": p.y_m} for p in rig.reference_points],
        "floor": None if rig.floor is None else [rig.floor.width_m, rig.floor.depth_m],
        "one_line": sides_alike(at_m),
        "stops": [
            {"marker": stop.marker_id, "seconds": (stop.end_ns - stop.start_ns) / NS_PER_S}
            for stop in scene.stops
        ],
        "model": None if scene.model is None else scene.model.name,
    }


def history_json(scene: Scene) -> dict[str, Any]:
    """What was measured so far, the newest first, withdrawn ones too; and which stops that are."""
    history = scene.history()
    active = active_measurements(history)
    points = {place.id: place.point_m for place in measured_places(active, scene.rig)[0]}
    rows = [
        {
            "id": measurement.id,
            "marker": measurement.marker_id,
            "counts": measurement in active,
            "point_m": points[measurement.id].tolist()
            if measurement in active and measurement.id in points
            else None,
            "tapes": _tapes(measurement),
        }
        for measurement in reversed(history)
        if measurement.withdraws is None
    ]
    return {"next": next_id(history), "places": rows, "measured": _measured(scene.stops, active)}


def _tapes(measurement: Measurement) -> str:
    tapes = [f"{tape.reference} {tape.distance_m * CM_PER_M:.1f}" for tape in measurement.distances]
    side = [measurement.side] if measurement.side else []
    height = [f"{measurement.height_m * CM_PER_M:.1f} high"] if measurement.height_m is not None else []
    return ", ".join([*tapes, *side, *height])


def _measured(stops: Sequence[Stop], active: Sequence[Measurement]) -> list[str | None]:
    """The measurement of each stop, None where there is none yet."""
    return [next((m.id for m in active if stop.covers(m)), None) for stop in stops]


def views_json(scene: Scene, views: Sequence[View], marker_id: int | None) -> dict[str, Any]:
    """What the cameras see now, and what they say of the chosen marker; of the only one if none is chosen."""
    visible = visible_markers(views, scene.rig)
    if marker_id is None and len(visible) == 1:
        marker_id = visible[0]
    sight = None if marker_id is None else look(views, marker_id)
    colours = camera_styles(view.camera for view in views)
    return {
        "marker": marker_id,
        "visible": visible,
        "state": sight.state if sight else "choose" if visible else "unseen",
        "text": _invitation(visible) if sight is None else sight.text,
        "cameras": [
            {
                "name": view.camera,
                "colour": colours[view.camera][0],
                "sees": sight is not None and view.camera in (*sight.points_m, *sight.moving),
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


def _invitation(visible: Sequence[int]) -> str:
    if not visible:
        return "no camera sees a marker: lay one down, face up"
    return f"choose the marker: {', '.join(map(str, visible))} are seen"


def checked_json(checked: Checked) -> dict[str, Any]:
    """What follows from what was typed."""
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
            {"camera": one.camera, "point_m": one.world_m.tolist(), "cm": one.off_m * CM_PER_M}
            for one in checked.predictions
        ],
        "sides": [{"side": side, "point_m": place_m.tolist()} for side, place_m in checked.sides_m],
        "ready": checked.measurement is not None,
    }
