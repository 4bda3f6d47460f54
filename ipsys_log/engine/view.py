"""The input of a stage from a log: its channels in log order, with the settings of the user."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from ipsys_log.engine.provenance import complete_runs, newest_run
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
from ipsys_log.messages.channels import CALIBRATIONS, EVENTS, IMAGES, RIG, Channel
from ipsys_log.messages.events import skipped_frames

if TYPE_CHECKING:
    from ipsys_log.engine.graph import Task
    from ipsys_log.engine.request import Progress


@dataclass(frozen=True, slots=True, eq=False)
class LogView:
    """The view of a stage on open logs.

    Attributes
    ----------
    inputs : by derived channel, the run that the stage reads.
    rig, given_lenses : they replace the rig and the camera intrinsics of the log.
    """

    session: Session
    inputs: Mapping[Channel, str] = field(default_factory=dict)
    rig: Rig | None = None
    given_lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)

    @property
    def cameras(self) -> set[str]:
        """Return the names of the cameras with images."""
        return set(self.session.images)

    @property
    def lenses(self) -> set[str]:
        """Return the names of the cameras with intrinsics, from the log or from the user."""
        return {*self.session.calibrations, *self.given_lenses}

    def calibrations(self) -> dict[str, CameraCalibration]:
        """Return the first intrinsics of each camera, from the log or from the user."""
        recorded = {
            camera: next(self.session.messages([topic])).payload
            for camera, topic in self.session.calibrations.items()
            if camera not in self.given_lenses
        }
        return {**recorded, **self.given_lenses}

    def run(self, channel: Channel) -> str:
        """Return the run that the stage reads of a derived channel; "" if there is none."""
        return self.inputs.get(channel, "")

    def topics(self, channel: Channel) -> list[str]:
        """Return the topics of a channel in the log, without replaced topics."""
        if channel is RIG:
            return [] if self.rig is not None else self.session.topics(RIG)
        if channel is CALIBRATIONS:
            calibrations = self.session.calibrations.items()
            return [topic for camera, topic in calibrations if camera not in self.given_lenses]
        if channel is IMAGES:
            return list(self.session.images.values())
        return self.session.topics(channel, self.run(channel) if channel.is_derived else None)

    def messages(self, *channels: Channel) -> Iterator[Message]:
        """Yield the messages of some channels in log order."""
        return self.session.messages([topic for channel in channels for topic in self.topics(channel)])

    def payloads(self, channel: Channel) -> list[Any]:
        """Return the payloads of a channel."""
        return self.session.payloads(self.topics(channel))

    def count(self, *channels: Channel) -> int:
        """Return the number of messages of some channels, from the index of the log."""
        return sum(self.session.count(topic) for channel in channels for topic in self.topics(channel))

    def last_ns(self, *channels: Channel) -> int:
        """Return the publish time of the last message of some channels."""
        return self.session.last([topic for channel in channels for topic in self.topics(channel)])[1]

    def newest(self, channel: Channel) -> str:
        """Return the newest complete run with a channel; "" if there is none."""
        return newest_run(self.session, channel) or ""

    def copied(self, channel: Channel) -> Iterator[tuple[str, Any]]:
        """Yield the complete runs with a channel, newest first, each with its last payload."""
        for run in reversed(complete_runs(self.session)):
            written = {output.topic for output in run.outputs}
            for topic in reversed(self.session.topics(channel, run.run)):
                if topic in written:
                    yield run.run, self.session.payloads([topic])[-1]


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
