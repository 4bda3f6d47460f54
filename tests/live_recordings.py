"""Recordings with live cameras that play the frames of a log."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

from ipsys_log.capture.frames import Clock
from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CompressedImage, Message
from ipsys_log.stages.detect import Detect
from ipsys_log.tools.differences import Comparison
from ipsys_log.tools.verify import verify
from tests.playing import SteppedClock, cameras, playing

# Slow enough for a busy machine.
RATE_HZ = 6.0


def sent(lab: Path) -> dict[str, list[bytes]]:
    """Return the frames of a log by camera."""
    with Session([lab]) as session:
        return {name: [p.data for p in session.payloads([t])] for name, t in session.images.items()}


def lenses(lab: Path) -> dict[str, CameraCalibration]:
    with Session([lab]) as session:
        return {name: session.payloads([topic])[0] for name, topic in session.calibrations.items()}


def attached_to(lab: Path, rate_hz: float) -> tuple[LiveCameras, list[Message]]:
    """Return cameras that play a log in real time, and the first messages of their recording."""
    frames = sent(lab)
    attached = LiveCameras(cameras(*frames), playing(frames, rate_hz), Clock())
    return attached, settings_of(lab, attached)


def attached_in_steps(
    lab: Path, frames: Mapping[str, Sequence[bytes]] | None = None
) -> tuple[LiveCameras, list[Message], SteppedClock]:
    """Return the same with a stepped clock; its ``watch`` must see the frames before other consumers."""
    frames = frames or sent(lab)
    clock = SteppedClock(list(frames), RATE_HZ)
    attached = LiveCameras(cameras(*frames), playing(frames, inf, before=clock.before), clock)
    return attached, settings_of(lab, attached), clock


def settings_of(lab: Path, attached: LiveCameras) -> list[Message]:
    """Return the first messages of a recording with the rig and the intrinsics of a log."""
    with Session([lab]) as session:
        (rig,) = session.payloads(["/rig"])
    return first_messages(rig, lenses(lab), attached.now_ns)


def go_live(lab: Path, calibration: Path, target: Path, rate_hz: float) -> None:
    """Record in real time: a busy machine skips frames."""
    attached, settings = attached_to(lab, rate_hz)
    with attached:
        pipeline.live(attached, settings, target, Request(model_from=calibration))


def record_every_frame(lab: Path, calibration: Path, target: Path) -> None:
    """Record on a fast machine: no frame is skipped."""
    attached, settings, clock = attached_in_steps(lab)
    with attached:
        pipeline.live(attached, settings, target, Request(model_from=calibration), sinks=[clock.watch])


def again(log: Path, run: str | None = None) -> list[Comparison]:
    return verify([log], run, lambda stage, done, total: None)


@cache
def slow(step: Callable[..., Any]) -> Callable[..., Any]:
    def slower(self: Detect, message: Message) -> Any:
        if isinstance(message.payload, CompressedImage):
            time.sleep(0.15)
        return step(self, message)

    return slower
