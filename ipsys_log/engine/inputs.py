"""The input of a causal stage from the log: settings first, then its channels in log order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from ipsys_log.engine.options import Progress
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    RIG_TOPIC,
    CameraCalibration,
    CompressedVideo,
    Message,
    Rig,
    SkippedVideo,
    calibration_topic,
)
from ipsys_log.messages.channels import EVENTS, RIG
from ipsys_log.messages.events import skipped_frames

if TYPE_CHECKING:
    from ipsys_log.engine.graph import Task


def inputs(session: Session, task: Task, progress: Progress) -> Iterator[Message]:
    """Yield the input of a causal stage: settings before the first frame, then its channels in log order."""
    yield from given_settings(session, task.rig, task.lenses)
    # The first rig and intrinsics of the log hold from its start, even if they were recorded a little later.
    for topic in sorted(task.topics):
        if topic in (*session.topics(RIG), *session.calibrations.values()):
            yield next(session.messages([topic]))
    total = sum(session.count(topic) for topic in task.topics)
    progress(task.stage.name, 0, total)
    skipped = left_out_frames(session, task)
    for done, message in enumerate(session.messages(task.topics), 1):
        if message.log_time_ns not in skipped:
            yield message
        elif isinstance(message.payload, CompressedVideo):
            # The next frames need it. Frames that live processing skipped before a keyframe have no effect.
            yield replace(message, payload=SkippedVideo(message.payload))
        progress(task.stage.name, done, total)


def given_settings(
    session: Session, rig: Rig | None, lenses: Mapping[str, CameraCalibration]
) -> Iterator[Message]:
    """Yield the rig and the intrinsics that replace those of the logs, from the start on."""
    start_ns = session.start_ns
    if rig is not None:
        yield Message(RIG_TOPIC, start_ns, start_ns, rig)
    for camera, lens in lenses.items():
        yield Message(calibration_topic(camera), start_ns, start_ns, lens, camera)


def left_out_frames(session: Session, task: Task) -> set[int]:
    """Return the log times in ns of the frames that a run leaves out: those that live processing skipped."""
    as_live = "as_live" in task.parameters
    return skipped_frames(session.payloads(session.topics(EVENTS))) if as_live else set()
