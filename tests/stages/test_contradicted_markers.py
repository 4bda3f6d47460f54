"""Markers that contradict the intrinsics of their camera, and sizes that contradict the rig."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ipsys_log.messages import CameraCalibration, CameraPoints, Event, Marker, Markers, Message, Pair
from ipsys_log.messages.events import CALIBRATION_CONTRADICTED
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.stages.camera_frame import METHODS, CameraFrame
from ipsys_log.stages.camera_frame import STAGE as CAMERA_FRAME
from ipsys_log.stages.detect import STAGE as DETECT
from ipsys_log.stages.detect.reports import LensInUse, Reports
from ipsys_log.statistics.camera_models import fit_model
from tests.analysis.marked_floor import FISHEYE, RIG, changed, sighted


def reported(lens: CameraCalibration) -> list[Any]:
    """Return what detection reports of 60 frames of a camera with these intrinsics."""
    reports = Reports()
    list(reports("red", [LensInUse(lens)]))
    frames = sighted(FISHEYE, np.random.default_rng(1))
    payloads = [Markers(n * 10**9, tuple(seen), 1920, 1080) for n, seen in enumerate(frames)]
    return [payload for frame in payloads for payload in reports("red", [frame])]


def marked(payloads: list[Any]) -> list[bool]:
    return [bool(m.contradicted) for p in payloads if isinstance(p, Markers) for m in p.markers]


def test_markers_are_marked_from_the_event_on() -> None:
    payloads = reported(changed(FISHEYE, f=1.1))
    first = next(n for n, payload in enumerate(payloads) if isinstance(payload, Event))
    assert payloads[first].kind == CALIBRATION_CONTRADICTED
    assert not any(marked(payloads[:first]))
    assert all(marked(payloads[first:]))


def test_wrong_length_is_named_with_its_marker() -> None:
    frame = CameraFrame("perimeter")
    for setting in (RIG, FISHEYE):
        list(frame(Message("t", 0, 0, setting, "red")))
    sightings = sighted(FISHEYE, np.random.default_rng(1), lengths_m=(0.2, 0.18, 0.2))
    frames = [Markers(n * 10**9, tuple(seen), 1920, 1080) for n, seen in enumerate(sightings)]
    payloads = [payload for seen in frames for payload in frame(Message("t", 1, 1, seen, "red"))]
    assert [p.marker_id for p in payloads if isinstance(p, Event)] == [1]


def test_honest_and_nominal_intrinsics_mark_nothing() -> None:
    assert not any(marked(reported(FISHEYE)))
    assert not any(marked(reported(replace(changed(FISHEYE, f=1.1), D=np.zeros(4)))))


@pytest.mark.parametrize("method", METHODS)
def test_positions_of_marked_markers_are_not_inside(method: str) -> None:
    frame = CameraFrame(method)
    for setting in (RIG, FISHEYE):
        list(frame(Message("t", 0, 0, setting, "red")))

    def camera_points(markers: list[Marker], contradicted: bool | None = None) -> CameraPoints:
        seen = tuple(replace(marker, contradicted=contradicted) for marker in markers)
        points: CameraPoints = list(frame(Message("t", 1, 1, Markers(1, seen, 1920, 1080), "red")))[-1]
        return points

    frames = sighted(FISHEYE, np.random.default_rng(1), frames=20)
    places_m = [np.array([p.x_m, p.y_m, p.z_m]) for seen in frames for p in camera_points(seen).points]
    pairs = [Pair(str(n), 0, place_m, place_m, 1) for n, place_m in enumerate(places_m)]
    locate = LocatePoints(fit_model("poly", {"red": pairs}, 0))
    for contradicted in (None, True):
        points = camera_points(frames[0], contradicted)
        (positions,) = locate(Message("t", 1, 1, points, "red"))
        assert {position.inside for position in positions.positions} == {not contradicted}


def test_detection_does_not_depend_on_lengths_and_heights() -> None:
    longer = replace(RIG, markers=(replace(RIG.markers[0], length_m=0.21), *RIG.markers[1:]))
    higher = replace(RIG, markers=(replace(RIG.markers[0], height_m=0.2), *RIG.markers[1:]))
    for stage, changes in ((DETECT, False), (CAMERA_FRAME, True)):
        parts = [stage.rig_part(rig, "") for rig in (RIG, longer, higher)]
        assert [part != parts[0] for part in parts[1:]] == [changes] * 2
