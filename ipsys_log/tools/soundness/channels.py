"""Channels of a log: their schemas, the decoding of their messages, their rates, and recorded events."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import BoundError
from ipsys_log.log.codec import PAYLOADS, payload_type, schema_data
from ipsys_log.log.contents import Schema, StoredChannel, camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Event, events
from ipsys_log.messages.channels import CHANNELS, EVENTS, IMAGES, RUN_EVENTS, channel_of
from ipsys_log.tools.recording import find_gaps
from ipsys_log.tools.soundness.finding import NOTE, REMARK, LogFinding
from ipsys_log.units import NS_PER_S

_PROGRESS_EVERY = 1000
# Events of the recorder or of a run that need no action.
_USUAL_EVENTS = frozenset(
    (
        *("camera_back", "ambiguous_marker", "unknown_marker", "rejected_marker", "robot_run"),
        *(events.NODE_ANSWERS, events.NODE_AWAITED, *events.OPERATOR_KINDS),
    )
)
_ADVICE = {
    events.FRAME_SKIPPED: "the frames are in the log: ipsys replay processes them",
    events.STAMP_UNRELIABLE: "these frames have their time of arrival",
    events.ASSUMED_MODEL: "if the model is wrong, import or record again with the corrected file",
    events.CONTRADICTED_HEIGHT: "correct lab.toml, and give it with --rig",
    events.FREE_BODY: "run ipsys replay --model joint",
    events.LOOSE_MARKER: "fix the marker, and run ipsys calibrate-body",
    events.TILTED_MARKER: "run ipsys replay --method pose",
    events.CALIBRATION_CONTRADICTED: (
        "correct lab.toml, or give the file with --calibration CAMERA=calibration.yaml"
    ),
    events.CAMERA_MOVED: "run ipsys replay --self-calibrate, or calibrate the camera again",
    events.CAMERA_DRIFTED: "run ipsys replay --self-calibrate, or calibrate the camera again",
    events.CAMERA_REPAIRED: "the positions use the new pose",
    events.CLOCK_JUMPED: "start the camera again",
    events.MARKER_MOVED: "measure its height, and correct lab.toml",
    events.MODEL_CONTRADICTED: "apply a model of this lab: ipsys replay LOG --model-from calibration.mcap",
    "frames_dropped": "record on a faster disk",
    "frames_missed": "reduce the rate or the size of the images, or use another USB bus",
}


def image_topics(channels: Mapping[str, StoredChannel]) -> set[str]:
    """Return the topics of the channels whose messages are images."""
    return {topic for topic, channel in channels.items() if _payload(channel) in IMAGES.payloads}


def _payload(channel: StoredChannel) -> type | None:
    return None if channel.schema is None else payload_type(channel.schema.name)


def check_schemas(session: Session) -> Iterator[LogFinding]:
    """Check that the schema of each known channel can be decoded; an unknown channel is no fault."""
    for reader in session.readers:
        for topic, text in reader.conflicts.items():
            advice = "write the channels with different topics"
            yield LogFinding("schema", REMARK, f"{text}: the topic cannot be read", advice, topic)
        for topic, channel in reader.channels.items():
            if topic not in reader.conflicts:
                yield from _check_schema(topic, channel)


def _check_schema(topic: str, channel: StoredChannel) -> Iterator[LogFinding]:
    name = "no schema" if channel.schema is None else f"the schema {channel.schema.name}"
    payload, count = _payload(channel), channel.message_count
    if payload is None or channel.schema is None or channel_of(topic, payload) is None:
        is_reserved = _is_reserved(topic)
        level = REMARK if is_reserved else NOTE
        text = f"has {name}, which ipsys does not read in this topic"
        advice = "give the channel another topic, or update ipsys" if is_reserved else ""
        yield LogFinding("schema", level, text, advice, topic, None, count)
        return
    difference = compare_schema(channel.schema)
    if difference.faults:
        more = f" and {len(difference.faults) - 1} more" if len(difference.faults) > 1 else ""
        text = f"{difference.faults[0]}{more}: the values of its messages may be wrong"
        yield LogFinding("schema", REMARK, text, "ask its sender for the software that wrote it", topic)
    elif difference.new_fields:
        text = f"newer software wrote it: {difference.new_fields[0]} is not known here"
        yield LogFinding("schema", NOTE, text, "update ipsys to read all fields", topic)


def _is_reserved(topic: str) -> bool:
    """Return whether a topic has a name of the channels of ipsys."""
    is_named = camera_of_topic(topic) is not None or run_of_topic(topic) is not None
    return is_named or any(channel.topic == topic for channel in CHANNELS)


def check_messages(session: Session, progress: Callable[[int], None]) -> Iterator[LogFinding]:
    """Decode each message of the known channels without images."""
    faults: dict[str, tuple[int, int, str]] = {}
    for number, (raw, message) in enumerate(session.attempts(decoded_topics(session)), 1):
        if isinstance(message, BoundError):
            raise message
        if isinstance(message, LogError):
            count, first_ns, text = faults.get(raw.topic, (0, raw.log_time_ns, _reason(message)))
            faults[raw.topic] = count + 1, first_ns, text
        if number % _PROGRESS_EVERY == 0:
            progress(number)
    for topic, (count, first_ns, text) in sorted(faults.items()):
        advice = "commands that read this topic stop there; ask its sender for the original log"
        yield LogFinding("message", REMARK, f"cannot be decoded: {text}", advice, topic, first_ns, count)


def _reason(error: LogError) -> str:
    """Return the text of an error without its place."""
    return str(error.__cause__ or error)


def decoded_topics(session: Session) -> list[str]:
    """Return the topics of all known channels without images."""
    return [
        topic
        for reader in session.readers
        for topic, channel in reader.channels.items()
        if topic not in reader.conflicts
        and _payload(channel) is not None
        and _payload(channel) not in IMAGES.payloads
    ]


def check_rates(session: Session) -> Iterator[LogFinding]:
    """Check the frames of each camera for gaps in which other cameras have frames."""
    times_ns = {topic: _times_ns(session, topic) for topic in session.images.values()}
    for camera, topic in session.images.items():
        gaps = find_gaps(times_ns[topic])
        if gaps.rate_hz is not None:
            text = f"{len(times_ns[topic])} frames of camera {camera} at {gaps.rate_hz:.1f} Hz"
            yield LogFinding("rate", NOTE, text, "", topic)
        others = [times for name, times in times_ns.items() if name != topic]
        margin_ns = round(gaps.usual_s * NS_PER_S)
        own: list[tuple[float, int]] = []
        common: list[tuple[float, int]] = []
        for start_ns, length_s in zip(gaps.starts_ns, gaps.lengths_s, strict=True):
            span_ns = start_ns + margin_ns, start_ns + round(length_s * NS_PER_S) - margin_ns
            goes_on = any(_has_time(other, *span_ns) for other in others)
            (own if goes_on else common).append((length_s, start_ns))
        if own:
            text = f"camera {camera} has no frames while others have: {_gaps(own)}"
            advice = "check its cable, its bus and the events of the recording"
            yield LogFinding("rate", REMARK, text, advice, topic, min(own, key=_start)[1], len(own))
        if common:
            text = f"the recording pauses: {_gaps(common)}"
            yield LogFinding("rate", NOTE, text, "", topic, min(common, key=_start)[1], len(common))


def _times_ns(session: Session, topic: str) -> NDArray[np.int64]:
    parts = [reader.times(topic) for reader in session.readers if topic in reader.channels]
    return np.sort(np.concatenate(parts))


def _has_time(times_ns: NDArray[np.int64], start_ns: int, end_ns: int) -> bool:
    first, last = np.searchsorted(times_ns, (start_ns, end_ns))
    return bool(last > first)


def _start(gap: tuple[float, int]) -> int:
    return gap[1]


def _gaps(gaps: list[tuple[float, int]]) -> str:
    longest = f"{max(gaps)[0]:.1f} s"
    return f"one gap of {longest}" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest {longest}"


def check_events(session: Session) -> Iterator[LogFinding]:
    """Report the events of the recorder and of runs, by kind and camera."""
    runs = [None, *sorted(session.run_names())]
    for run in runs:
        for topic in session.topics(EVENTS if run is None else RUN_EVENTS, run):
            groups: dict[tuple[str, str], tuple[int, int, str]] = {}
            for raw, message in session.attempts([topic]):
                if not isinstance(message, LogError) and isinstance(message.payload, Event):
                    event = message.payload
                    key = event.kind, event.camera or ""
                    count, first_ns, text = groups.get(key, (0, raw.log_time_ns, event.text))
                    groups[key] = count + 1, first_ns, text
            for (kind, _), (count, first_ns, text) in groups.items():
                level = NOTE if kind in _USUAL_EVENTS else REMARK
                advice = _ADVICE.get(kind, "" if level == NOTE else "ipsys cat shows all events")
                yield LogFinding("event", level, f"{kind}: {text}", advice, topic, first_ns, count)


class SchemaDifference(NamedTuple):
    """The fields of a stored schema that this version reads differently, and those that it does not know."""

    faults: tuple[str, ...] = ()
    new_fields: tuple[str, ...] = ()


def compare_schema(schema: Schema) -> SchemaDifference:
    """Compare a stored schema with the schema of the same name of this version.

    Schemas that this version does not decode by protobuf give no difference.
    """
    if schema.name not in PAYLOADS or schema.encoding != "protobuf":
        return SchemaDifference()
    try:
        stored = _messages(FileDescriptorSet.FromString(schema.data))
    except (DecodeError, RecursionError):
        return SchemaDifference(("its definition is not valid",))
    if schema.name not in stored:
        return SchemaDifference((f"its definition does not contain {schema.name}",))
    known = _messages(FileDescriptorSet.FromString(schema_data(schema.name)))
    faults: list[str] = []
    new_fields: list[str] = []
    for name in sorted(stored.keys() & known.keys()):
        fields = {field.number: field for field in known[name].field}
        for field in stored[name].field:
            title = f"field {field.number} of {name} ({field.name})"
            if field.number not in fields:
                new_fields.append(title)
            elif _meaning(field) != _meaning(fields[field.number]):
                faults.append(f"{title} is another field here ({fields[field.number].name})")
    return SchemaDifference(tuple(faults), tuple(new_fields))


def _meaning(field: FieldDescriptorProto) -> tuple[str, int, str, bool]:
    """Return the name and the form of a field in the bytes of a message."""
    is_list = field.label == FieldDescriptorProto.LABEL_REPEATED
    return field.name, field.type, field.type_name, is_list


def _messages(files: FileDescriptorSet) -> dict[str, DescriptorProto]:
    """Return the messages of a descriptor set by full name, with nested messages."""

    def nested(scope: str, message: DescriptorProto) -> Iterator[tuple[str, DescriptorProto]]:
        name = f"{scope}.{message.name}"
        yield name, message
        for inner in message.nested_type:
            yield from nested(name, inner)

    return {
        name: definition
        for file in files.file
        for message in file.message_type
        for name, definition in nested(file.package, message)
    }
