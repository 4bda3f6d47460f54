"""A live recording with late, early and missing sightings: the tracks of a replay have the same bytes."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message
from ipsys_log.messages.channels import POSITIONS
from tests.live_recordings import RATE_HZ, again, sent, settings_of
from tests.playing import SteppedClock, cameras, playing

_MS = 1_000_000
_FRAMES = 18
_USUAL_MS, _LATE_MS, _TOO_LATE_MS, _EARLY_MS = 1, 300, 900, -40


def age_ms(camera: str, number: int) -> int:
    """Return the time from the stamp of a frame to its arrival."""
    if (camera, number) == ("black", 12):
        return _TOO_LATE_MS
    if camera == "red" and number % 4 == 3:
        return _LATE_MS
    return _EARLY_MS if camera == "white" and number % 5 == 3 else _USUAL_MS


def with_gaps(frames: dict[str, list[bytes]]) -> dict[str, list[bytes]]:
    """Return frames of robots that stand still; in some of them, a camera is covered."""
    covered = cv2.imencode(".jpg", np.full((540, 960), 128, dtype=np.uint8))[1].tobytes()
    gaps = {"red": {6}, "white": {4, 5}, "black": {1, 7, 8}}
    return {
        name: [covered if number in gaps[name] else own[number % 2] for number in range(_FRAMES)]
        for name, own in frames.items()
    }


def record_out_of_order(
    lab: Path, calibration: Path, target: Path, age: Callable[[str, int], int]
) -> list[Message]:
    """Record, and return the positions of the log in its order."""
    frames = with_gaps(sent(lab))
    clock = SteppedClock(list(frames), RATE_HZ)
    opened = playing(
        frames, inf, before=clock.before, age_ns=lambda camera, number: _MS * age(camera, number)
    )
    attached = LiveCameras(cameras(*frames), opened, clock)
    settings = settings_of(lab, attached)
    with attached:
        pipeline.live(attached, settings, target, Request(model_from=calibration), sinks=[clock.watch])
    with Session([target]) as session:
        return list(session.messages(session.topics(POSITIONS, "poly")))


@pytest.mark.slow
def test_late_early_and_missing_sightings_replay_alike(
    lab_log: Path, calibration: Path, tmp_path: Path
) -> None:
    log = tmp_path / "live.mcap"
    positions = record_out_of_order(lab_log, calibration, log, age_ms)
    ages_ms = [(m.log_time_ns - m.publish_time_ns) / _MS for m in positions]
    # The log holds all kinds of sightings.
    assert min(ages_ms) < 0
    assert any(_LATE_MS <= age < _TOO_LATE_MS for age in ages_ms)
    assert max(ages_ms) >= _TOO_LATE_MS
    assert sum(not message.payload.positions for message in positions) == 6
    with Session([log]) as session:
        rows = list(session.messages(["/runs/poly/tracks"]))
    times_ns = [message.payload.timestamp for message in rows]
    # A late sighting has its own row, after the rows of later instants; one that is too late has none.
    assert times_ns != sorted(times_ns)
    too_late_ns = positions[int(np.argmax(ages_ms))].publish_time_ns
    assert too_late_ns not in set(times_ns)
    compared = again(log)
    assert "/runs/poly/tracks" in {one.topic for one in compared}
    assert all(one.equal and one.left > 0 for one in compared)
