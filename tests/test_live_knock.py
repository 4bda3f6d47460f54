"""A camera that is knocked while it records: an event in the log, and the same bytes in a replay."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CAMERA_MOVED, Event, Markers, ReferenceMarker
from ipsys_log.messages.channels import EVENTS, MARKERS
from ipsys_log.tools.verify import verify
from ipsys_log.units import NS_PER_S
from tests.live_recordings import lenses, sent
from tests.playing import SteppedClock, cameras, playing

CAMERA, RATE_HZ = "white", 10.0
BEFORE, AFTER = 14, 10


def knocked_frames(frame: bytes) -> list[bytes]:
    """Return a frame many times, then the same scene shifted by 6 px."""
    image = cv2.imdecode(np.frombuffer(frame, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    shifted = cv2.imencode(".jpg", np.roll(image, 6, axis=1), [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    still = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    return [still] * BEFORE + [shifted] * AFTER


@pytest.fixture(scope="module")
def recorded(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Return a live recording of one camera with reference markers, and the printed lines."""
    said: list[str] = []
    target = tmp_path_factory.mktemp("knock") / "live.mcap"
    with Session([lab_log]) as session:
        (rig,) = session.payloads(["/rig"])
    rig = replace(rig, markers=(), reference_markers=tuple(ReferenceMarker(n) for n in range(8)))
    frames = {CAMERA: knocked_frames(sent(lab_log)[CAMERA][0])}
    clock = SteppedClock([CAMERA], RATE_HZ)
    attached = LiveCameras(cameras(CAMERA), playing(frames, inf, before=clock.before), clock, said.append)
    settings = first_messages(rig, {CAMERA: lenses(lab_log)[CAMERA]}, attached.now_ns)
    with attached:
        pipeline.live(attached, settings, target, Request(), "detect", [clock.watch])
    return target, said


def test_knock_is_an_event_within_a_second(recorded: tuple[Path, list[str]]) -> None:
    log, said = recorded
    with Session([log]) as session:
        frames: list[Markers] = session.payloads(session.topics(MARKERS, "edges"))
        events: list[Event] = [
            one for one in session.payloads(session.topics(EVENTS)) if one.kind == CAMERA_MOVED
        ]
    assert len(frames) == BEFORE + AFTER
    assert any(frame.markers for frame in frames)
    assert [event.camera for event in events] == [CAMERA]
    assert 0 < events[0].timestamp - frames[BEFORE].timestamp < NS_PER_S
    assert [line for line in said if "has moved" in line] == [events[0].text]


def test_recording_with_a_knock_equals_its_replay(recorded: tuple[Path, list[str]]) -> None:
    comparisons = verify([recorded[0]], None, lambda stage, done, total: None)
    assert comparisons
    assert all(one.equal for one in comparisons)
