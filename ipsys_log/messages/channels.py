"""The channels of a log, in one table: their topics, their payloads, and their recognition by a reader."""

import re
from dataclasses import dataclass
from functools import lru_cache

from ipsys_log.messages.events import ClockEstimate, Cut, Event, Latency, Merge, Run
from ipsys_log.messages.images import (
    CameraPoints,
    CompressedImage,
    CompressedVideo,
    ImageAnnotations,
    Markers,
    RawImage,
    SkippedVideo,
)
from ipsys_log.messages.models import CameraPoses, Evaluation, Measurement, Model
from ipsys_log.messages.rig import CameraCalibration, Rig
from ipsys_log.messages.tracks import FrameTransforms, Positions, RobotPath, Tracks, WheelCommand


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channel:
    """A channel: its identity in every log and for every stage. Two channels may have one payload type.

    Attributes
    ----------
    name : unique in the table.
    topic : pattern of its topics, with ``{run}`` and ``{camera}``.
    payloads : types of its messages.
    by_schema : a topic outside of all runs with another name is this channel if it has such a payload. Other
        programs use their own topic names.
    lasting : its messages hold beyond their instant, or describe the whole log: a part of a log has them all.
    """

    name: str
    topic: str
    payloads: tuple[type, ...]
    by_schema: bool = False
    lasting: bool = False

    def __repr__(self) -> str:
        return f"<channel {self.name}>"

    @property
    def is_derived(self) -> bool:
        """Return whether a stage writes the channel, in a run."""
        return self.topic.startswith("/runs/")

    def topic_of(self, run: str | None = None, camera: str | None = None) -> str:
        """Return the topic of a run and a camera."""
        return _topic(self.topic, run, camera)


@lru_cache(4096)
def _topic(pattern: str, run: str | None, camera: str | None) -> str:
    return pattern.format(run=run, camera=camera)


RIG = Channel(name="rig", topic="/rig", payloads=(Rig,), by_schema=True, lasting=True)
# No log contains a skipped frame of a video as such: the log has the frame, and an event names it.
IMAGES = Channel(
    name="images",
    topic="/cameras/{camera}/image",
    payloads=(CompressedImage, CompressedVideo, RawImage, SkippedVideo),
    by_schema=True,
)
CALIBRATIONS = Channel(
    name="calibrations",
    topic="/cameras/{camera}/calibration",
    payloads=(CameraCalibration,),
    by_schema=True,
    lasting=True,
)
CLOCKS = Channel(name="clocks", topic="/cameras/{camera}/clock", payloads=(ClockEstimate,))
MEASUREMENTS = Channel(
    name="measurements", topic="/measurements", payloads=(Measurement,), by_schema=True, lasting=True
)
EVENTS = Channel(name="events", topic="/events", payloads=(Event,), by_schema=True)
LATENCY = Channel(name="latency", topic="/latency", payloads=(Latency,), by_schema=True)
TRUTH = Channel(name="truth", topic="/truth/tracks", payloads=(Tracks,), by_schema=True)
PATHS = Channel(name="paths", topic="/robots/paths", payloads=(RobotPath,), by_schema=True, lasting=True)
COMMANDS = Channel(name="commands", topic="/robots/commands", payloads=(WheelCommand,), by_schema=True)
CUTS = Channel(name="cuts", topic="/cuts", payloads=(Cut,), lasting=True)
MERGES = Channel(name="merges", topic="/merges", payloads=(Merge,), lasting=True)

RECORD = Channel(name="record", topic="/runs/{run}/record", payloads=(Run,), lasting=True)
MARKERS = Channel(name="markers", topic="/runs/{run}/cameras/{camera}/markers", payloads=(Markers,))
ANNOTATIONS = Channel(
    name="annotations", topic="/runs/{run}/cameras/{camera}/annotations", payloads=(ImageAnnotations,)
)
CAMERA_POINTS = Channel(
    name="camera_points", topic="/runs/{run}/cameras/{camera}/camera_points", payloads=(CameraPoints,)
)
MODEL = Channel(name="model", topic="/runs/{run}/model", payloads=(Model,), lasting=True)
CAMERA_POSES = Channel(
    name="camera_poses", topic="/runs/{run}/camera_poses", payloads=(CameraPoses,), lasting=True
)
EVALUATION = Channel(name="evaluation", topic="/runs/{run}/evaluation", payloads=(Evaluation,), lasting=True)
POSITIONS = Channel(name="positions", topic="/runs/{run}/cameras/{camera}/positions", payloads=(Positions,))
TRACKS = Channel(name="tracks", topic="/runs/{run}/tracks", payloads=(Tracks,))
SMOOTHED_TRACKS = Channel(name="smoothed_tracks", topic="/runs/{run}/smoothed_tracks", payloads=(Tracks,))
ESTIMATE = Channel(name="estimate", topic="/runs/{run}/estimate", payloads=(Tracks,))
CALIBRATED_RIG = Channel(name="calibrated_rig", topic="/runs/{run}/rig", payloads=(Rig,), lasting=True)
POSES = Channel(name="poses", topic="/runs/{run}/poses", payloads=(FrameTransforms,))
# The only channel that several stages of a run write.
RUN_EVENTS = Channel(name="run_events", topic="/runs/{run}/events", payloads=(Event,))

CHANNELS: tuple[Channel, ...] = (
    *(RIG, IMAGES, CALIBRATIONS, CLOCKS, MEASUREMENTS, EVENTS, LATENCY, TRUTH, PATHS, COMMANDS, CUTS, MERGES),
    *(RECORD, MARKERS, ANNOTATIONS, CAMERA_POINTS, MODEL, CAMERA_POSES, EVALUATION, POSITIONS, TRACKS),
    *(POSES, SMOOTHED_TRACKS, ESTIMATE, CALIBRATED_RIG, RUN_EVENTS),
)

RIG_TOPIC = RIG.topic
MEASUREMENTS_TOPIC = MEASUREMENTS.topic
EVENTS_TOPIC = EVENTS.topic
LATENCY_TOPIC = LATENCY.topic
TRUTH_TOPIC = TRUTH.topic
PATHS_TOPIC = PATHS.topic
COMMANDS_TOPIC = COMMANDS.topic

_NAME = "[a-z][a-z0-9_]*"
_TOPIC = re.compile(rf"(?P<run>/runs/{_NAME})?(?P<camera>/cameras/{_NAME})?(?P<rest>/.*)", re.DOTALL)


def image_topic(camera: str) -> str:
    """Return the topic of the images of a camera."""
    return IMAGES.topic_of(camera=camera)


def calibration_topic(camera: str) -> str:
    """Return the topic of the intrinsics of a camera."""
    return CALIBRATIONS.topic_of(camera=camera)


def clock_topic(camera: str) -> str:
    """Return the topic of the estimates of the clock of a camera's node."""
    return CLOCKS.topic_of(camera=camera)


def channel_of(topic: str, payload: type | None) -> Channel | None:
    """Return the channel of a topic with messages of a type; None if the table has none.

    The name of the topic decides. Outside of all runs, the payload decides if no name fits.

    Examples
    --------
    >>> channel_of("/runs/poly/tracks", Tracks)
    <channel tracks>
    >>> channel_of("/front/image_raw", RawImage)
    <channel images>
    """
    pattern = _pattern_of(topic)
    if pattern is None or payload is None:
        return None
    fitting = [channel for channel in CHANNELS if payload in channel.payloads]
    named = next((channel for channel in fitting if channel.topic == pattern), None)
    if named is not None or pattern.startswith("/runs/"):
        return named
    return next((channel for channel in fitting if channel.by_schema), None)


@lru_cache(4096)  # a log has few topics, but many messages
def _pattern_of(topic: str) -> str | None:
    """Return the topic with placeholders for the names of the run and the camera."""
    match = _TOPIC.fullmatch(topic)
    if match is None:
        return None
    return f"{'/runs/{run}' * bool(match['run'])}{'/cameras/{camera}' * bool(match['camera'])}{match['rest']}"
