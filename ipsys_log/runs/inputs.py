"""The input of a causal stage from the log: settings first, then its channels in log order."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

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
from ipsys_log.runs.options import Progress

if TYPE_CHECKING:
    from ipsys_log.runs.graph import Task


def inputs(session: Session, task: Task, progress: Progress) -> Iterator[Message]:
    """Yield the input of a causal stage: settings before the first frame, then its channels in log order."""
    yield from first_settings(session, task, task.topics)
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


def first_settings(session: Session, task: Task, topics: Collection[str]) -> Iterator[Message]:
    """Yield the settings that hold from the start: those of the user, and the first ones of some topics.

    The first rig and intrinsics of the log are valid from its start, even if they were recorded a little
    later.
    """
    yield from given_settings(session, task.rig, task.lenses)
    for topic in sorted(topics):
        if topic in (*session.topics(RIG), *session.calibrations.values()):
            yield next(session.messages([topic]))


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
    """Return the log times in ns of the frames that a run leaves out."""
    return skipped_frames(session.payloads(session.topics(EVENTS))) if leaves_out_frames(task) else set()


def leaves_out_frames(task: Task) -> bool:
    """Return whether a run leaves out the frames that live processing skipped."""
    return "as_live" in task.parameters
