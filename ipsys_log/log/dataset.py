"""One or several logs as one stream of decoded messages, from any recorder.

Logs of this program name their cameras in their topics. In logs of other recorders, the schema identifies
images and calibrations, and the topic or the shared ``frame_id`` gives the name of the camera.
"""

import heapq
import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from copy import copy
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import BoundError, PartCounter
from ipsys_log.log.codec import decode, payload_type
from ipsys_log.log.contents import (
    RawMessage,
    StoredChannel,
    camera_of_topic,
    clean_name,
    parse_foreign_camera,
    run_of_topic,
)
from ipsys_log.log.location import LogLocation
from ipsys_log.log.merged_logs import check_overlaps, check_same_parameters, find_new_ids, rename_ids
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import ASSUMED_MODEL, Cut, Measurement, Merge, MergedLog, Message, Run
from ipsys_log.messages.channels import (
    CALIBRATIONS,
    CUTS,
    EVENTS,
    IMAGES,
    MEASUREMENTS_TOPIC,
    MERGES,
    Channel,
    channel_of,
)

_ITEMS_OF_IMAGE = 16
_LATEST_NS = 1 << 63


class Session:
    """Open logs, read together in log order. A context manager.

    If two logs have measurements with the same id, that of the later log gets a new id, such as ``p001_2``.

    Parameters
    ----------
    paths : the logs, files or URLs; at equal times, messages of an earlier log come first.

    Attributes
    ----------
    images, calibrations : topic by camera.
    """

    def __init__(self, paths: Sequence[LogLocation]) -> None:
        self.paths = list(paths)
        self._stack = ExitStack()
        self._hidden: Collection[str] = ()
        self._channels: dict[tuple[str, str], Channel | None] = {}
        try:
            self.readers = [self._stack.enter_context(LogReader(path)) for path in paths]
            self._check_numbers()
            check_overlaps(self.readers, set(self.topics(IMAGES)))
            self.images = self._cameras(IMAGES)
            self.calibrations = self._pair_calibrations(self._cameras(CALIBRATIONS))
            self._camera_of = {
                topic: name for topics in (self.images, self.calibrations) for name, topic in topics.items()
            }
            self._ids: dict[LogReader, dict[str, str]] = {}
            self._ids = self._find_new_ids()
            self._check_same_parameters()
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def __str__(self) -> str:
        return ", ".join(str(path) for path in self.paths)

    @property
    def start_ns(self) -> int:
        return min((r.start_ns for r in self.readers if r.start_ns is not None), default=0)

    @property
    def end_ns(self) -> int:
        return max((r.end_ns for r in self.readers if r.end_ns is not None), default=0)

    def assumed_models(self) -> dict[str, str]:
        """Return the cameras whose calibration file did not state the lens model, each with a text on it."""
        events = (event for _, event in self.attempts(self.topics(EVENTS)) if isinstance(event, Message))
        return {
            str(event.payload.camera): event.payload.text
            for event in events
            if event.payload.kind == ASSUMED_MODEL
        }

    def topics(self, channel: Channel, run: str | None = None) -> list[str]:
        """Return the topics of a channel that have messages: of one run, or with None outside of all runs."""
        stored_topics = {
            topic
            for reader in self.readers
            for topic, stored in reader.channels.items()
            if stored.message_count > 0
            and topic not in self._hidden
            and self._channel_of(topic, stored) is channel
            and run_of_topic(topic) == run
        }
        return sorted(stored_topics)

    def _channel_of(self, topic: str, stored: StoredChannel) -> Channel | None:
        schema = stored.schema.name if stored.schema is not None else ""
        key = topic, schema
        if key not in self._channels:
            self._channels[key] = channel_of(topic, payload_type(schema) if schema else None)
        return self._channels[key]

    def last(self, topics: Collection[str]) -> tuple[int, int]:
        """Return log time and publish time of the last message of some topics; the start if there is none."""
        last_times = [
            (time_ns, reader, topic)
            for reader in self.readers
            for topic in topics
            if topic in reader.channels and (time_ns := reader.last_time(topic)) is not None
        ]
        if not last_times:
            return self.start_ns, self.start_ns
        last_ns, reader, topic = max(last_times, key=lambda item: item[0])
        *_, message = reader.messages([topic], start_ns=last_ns)
        return message.log_time_ns, message.publish_time_ns

    def order(self, topics: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the log times in ns and the places in ``topics`` of messages, (N,) each, in log order."""
        times_ns, places = zip(*(reader.order(topics) for reader in self.readers), strict=True)
        order = np.argsort(joined_ns := np.concatenate(times_ns), kind="stable")
        return joined_ns[order], np.concatenate(places)[order]

    def latest(self, topic: str, before_ns: int) -> Message | None:
        """Return the last message of a topic before a log time in ns; the first one if there is none."""
        times_ns = [reader.times(topic) for reader in self.readers if topic in reader.channels]
        before = [times[times < before_ns] for times in times_ns]
        last_ns = max((int(times[-1]) for times in before if len(times)), default=None)
        if last_ns is None:
            return next(self.messages([topic]), None)
        *_, message = self.messages([topic], last_ns, last_ns + 1)
        return message

    def run_names(self) -> set[str]:
        """Return the names of all runs that have a channel, complete or not."""
        return {run for reader in self.readers for topic in reader.channels if (run := run_of_topic(topic))}

    def unread_images(self) -> list[str]:
        """Return the topics that look like images, but have a schema that this version cannot read."""
        schemas = {
            topic: channel.schema.name
            for reader in self.readers
            for topic, channel in reader.channels.items()
            if channel.schema is not None and payload_type(channel.schema.name) is None
        }
        return [
            f"{topic} ({name})"
            for topic, name in sorted(schemas.items())
            if re.search("image|video", name, re.IGNORECASE)
        ]

    def count(self, topic: str) -> int:
        return sum(r.channels[topic].message_count for r in self.readers if topic in r.channels)

    def hash(self, topic: str) -> str:
        """Return the hash of a channel's messages, which does not depend on their file.

        With several logs, it is the hash of each log, joined by "+".
        """
        parts = [r for r in self.readers if topic in r.channels and r.channels[topic].message_count]
        if len(parts) > 1:  # the order is that of their times, not that of the command line
            parts.sort(key=lambda reader: reader.first_time(topic) or 0)
        return "+".join(reader.channel_hash(topic) for reader in parts)

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the decoded messages of some topics in log order, from ``start_ns`` to before ``end_ns``.

        Raises
        ------
        LogError
            A message does not match the schema of its channel; the text names topic and file.
        """
        streams: list[Iterator[Message]] = [
            self._decoded(reader, items, topics, start_ns, end_ns) for reader, items in self._items()
        ]
        return heapq.merge(*streams, key=lambda message: message.log_time_ns)

    def stored(self, topics: Collection[str]) -> Iterator[tuple[Message, bytes]]:
        """Yield the same as :meth:`messages`, each with the encoded bytes of its payload."""
        streams = [self._stored(reader, items, topics) for reader, items in self._items()]
        return heapq.merge(*streams, key=lambda row: row[0].log_time_ns)

    def attempts(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[RawMessage, Message | LogError]]:
        """Yield the messages of some topics in log order, each decoded, or with the error of its decoding."""
        streams = [self._attempts(reader, items, topics, start_ns, end_ns) for reader, items in self._items()]
        return heapq.merge(*streams, key=lambda row: row[0].log_time_ns)

    def _attempts(
        self,
        reader: LogReader,
        items: PartCounter,
        topics: Collection[str],
        start_ns: int | None,
        end_ns: int | None,
    ) -> Iterator[tuple[RawMessage, Message | LogError]]:
        for raw in self._raw(reader, topics, start_ns, end_ns):
            try:
                yield raw, self._message(reader, raw, items)
            except LogError as error:
                yield raw, error

    def encoded(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, int, int, bytes]]:
        """Yield topic, log time, publish time and encoded payload of messages in log order."""
        for reader in self.readers:
            for topic in topics:
                if topic in reader.channels and reader.channels[topic].message_encoding != "protobuf":
                    raise LogError(f"{reader.path}: {topic} is not encoded with protobuf")
        streams = [self._bounded(reader, topics, start_ns, end_ns) for reader in self.readers]
        raw = streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda one: one.log_time_ns)
        for message in raw:
            if max(message.log_time_ns, message.publish_time_ns) >= _LATEST_NS:
                where = f"{self}: {message.topic} at {message.log_time_ns} ns"
                raise LogError(
                    f"{where}: its time is later than the year 2262; the clock of its recorder was wrong"
                )
            yield message.topic, message.log_time_ns, message.publish_time_ns, message.data

    def _stored(
        self, reader: LogReader, items: PartCounter, topics: Collection[str]
    ) -> Iterator[tuple[Message, bytes]]:
        for raw in self._raw(reader, topics, None, None):
            yield self._message(reader, raw, items), bytes(raw.data)

    def _raw(
        self, reader: LogReader, topics: Collection[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        present = [topic for topic in topics if topic in reader.channels]
        return reader.messages(present, start_ns, end_ns) if present else iter(())

    def _bounded(
        self, reader: LogReader, topics: Collection[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        """Yield messages that are not images, as stored."""
        most = reader.read_limits.max_structured
        for raw in self._raw(reader, topics, start_ns, end_ns):
            if len(raw.data) > most:
                where = f"{reader.path}: {raw.topic} at {raw.log_time_ns} ns"
                raise BoundError(f"{where}: {_too_large(raw.data)}")
            yield raw

    def part_counter(self) -> PartCounter:
        """Return the counter of the message parts in one reading of all logs."""
        return PartCounter(sum(reader.read_limits.max_items for reader in self.readers))

    def _items(self) -> list[tuple[LogReader, PartCounter]]:
        """Return the logs, each with the limits for one reading."""
        return [(reader, PartCounter(reader.read_limits.max_items)) for reader in self.readers]

    def _decoded(
        self,
        reader: LogReader,
        items: PartCounter,
        topics: Collection[str],
        start_ns: int | None,
        end_ns: int | None,
    ) -> Iterator[Message]:
        for raw in self._raw(reader, topics, start_ns, end_ns):
            yield self._message(reader, raw, items)

    def _message(self, reader: LogReader, raw: RawMessage, items: PartCounter) -> Message:
        channel = reader.channels[raw.topic]
        payload = _payload(reader, raw, items)
        if isinstance(payload, Measurement) and reader in self._ids:
            payload = rename_ids(payload, self._ids[reader])
        camera = self.camera_of(raw.topic)
        # The log time of a ROS 2 recorder is the arrival; the message contains the time of its frame.
        taken_ns = payload.timestamp if channel.message_encoding == "cdr" else 0
        return Message(raw.topic, raw.log_time_ns, taken_ns or raw.publish_time_ns, payload, camera)

    def payloads(self, topics: Collection[str]) -> list[Any]:
        return [message.payload for message in self.messages(topics)]

    def runs(self) -> list[Run]:
        """Return the records of the stages, oldest first: in the order of the given logs, then by number."""
        return list(self._runs)

    @cached_property
    def _runs(self) -> list[Run]:
        return [run for reader, items in self._items() for run in self._runs_in(reader, items)]

    def _runs_in(self, reader: LogReader, items: PartCounter) -> list[Run]:
        topics = [
            topic
            for topic, stored in reader.channels.items()
            if stored.schema is not None and payload_type(stored.schema.name) is Run
        ]
        runs = [message.payload for message in self._decoded(reader, items, topics, None, None)]
        return sorted(runs, key=lambda run: run.number)

    @cached_property
    def copies(self) -> dict[LogReader, list[Cut | MergedLog]]:
        """The records of cuts and of merges of each log that was copied from others, the oldest first.

        A merge has one record for each of its logs.
        """
        topics = [*self.topics(CUTS), *self.topics(MERGES)]
        parts = {
            reader: [
                record
                for message in self._decoded(reader, items, topics, None, None)
                for record in _copy_records(message.payload)
            ]
            for reader, items in (self._items() if topics else ())
        }
        return {reader: copies for reader, copies in parts.items() if copies}

    def with_cameras(self, cameras: Collection[str]) -> Self:
        """Return a view of these logs with the channels of these cameras only; it ends with this session."""
        view = copy(self)
        view.images = {camera: topic for camera, topic in self.images.items() if camera in cameras}
        view.calibrations = {
            camera: topic for camera, topic in self.calibrations.items() if camera in cameras
        }
        topics = {topic for reader in self.readers for topic in reader.channels}
        view._hidden = {topic for topic in topics if self.camera_of(topic) not in (None, *cameras)}
        return view

    def camera_of(self, topic: str) -> str | None:
        """Return the camera of a topic; None if it has none."""
        return self._camera_of.get(topic) or camera_of_topic(topic)

    def _check_same_parameters(self) -> None:
        names = [{run_of_topic(topic) for topic in reader.channels} - {None} for reader in self.readers]
        if sum(map(len, names)) > len(set().union(*names)):  # the records are read only if runs have one name
            check_same_parameters(
                (reader.path, self._runs_in(reader, items)) for reader, items in self._items()
            )

    def _find_new_ids(self) -> dict[LogReader, dict[str, str]]:
        """Return the ids of measurements that an earlier log has too, and their new ids."""
        named = [reader for reader in self.readers if MEASUREMENTS_TOPIC in reader.channels]
        readers = [reader for reader in named if reader.channels[MEASUREMENTS_TOPIC].message_count]
        if len(readers) < 2:
            return {}
        readers.sort(key=lambda reader: reader.first_time(MEASUREMENTS_TOPIC) or 0)
        new_ids = find_new_ids(
            [
                message.payload
                for message in self._decoded(
                    reader, PartCounter(reader.read_limits.max_items), [MEASUREMENTS_TOPIC], None, None
                )
                if isinstance(message.payload, Measurement)
            ]
            for reader in readers
        )
        return dict(zip(readers, new_ids, strict=True))

    @property
    def has_new_ids(self) -> bool:
        """True if measurements of a later log have new ids here, because an earlier log has their ids too."""
        return any(self._ids.values())

    def _check_numbers(self) -> None:
        """Refuse more runs or measurements than a lab has: each of them costs a line, or an equation."""
        for reader in self.readers:
            for payload, kind in ((Run, "runs"), (Measurement, "measurements")):
                counts = [
                    channel.message_count
                    for channel in reader.channels.values()
                    if channel.schema is not None and payload_type(channel.schema.name) is payload
                ]
                reader.view.check_number(sum(counts), kind)

    def _cameras(self, channel: Channel) -> dict[str, str]:
        """Return the topic by camera; if a camera has topics of several types, that of the first type."""
        cameras: dict[str, str] = {}
        for payload in channel.payloads:
            topics = [topic for topic in self.topics(channel) if self.has_payload(topic, payload)]
            names = [camera_of_topic(topic) or parse_foreign_camera(topic) for topic in topics]
            topic_of: dict[str, str] = {}
            for topic, name in zip(topics, names, strict=True):
                # Topics that differ only in words such as color or mono keep these words.
                camera = name if names.count(name) == 1 else clean_name(topic)
                if camera in topic_of:
                    raise LogError(
                        f"{self}: two cameras have the same name {camera!r}: {topic_of[camera]} and "
                        f"{topic}; rename one of the topics"
                    )
                topic_of[camera] = topic
            cameras = topic_of | cameras
        return cameras

    def has_payload(self, topic: str, payload: type) -> bool:
        """Return whether a topic has messages of a type, in one of the logs."""
        stored = (reader.channels[topic] for reader in self.readers if topic in reader.channels)
        return any(
            channel.schema is not None and payload_type(channel.schema.name) is payload for channel in stored
        )

    def _pair_calibrations(self, found: dict[str, str]) -> dict[str, str]:
        """Give each calibration the name of its camera: by topic, else by a shared ``frame_id``."""
        paired = {camera: topic for camera, topic in found.items() if camera in self.images}
        rest = {camera: topic for camera, topic in found.items() if camera not in paired}
        waiting = {c: self._frame_id(t) for c, t in self.images.items() if c not in paired} if rest else {}
        for camera, topic in rest.items():
            frame_id = self._frame_id(topic)
            matches = [image for image, image_frame in waiting.items() if image_frame == frame_id]
            paired[matches[0] if len(matches) == 1 else camera] = topic
        return paired

    def _frame_id(self, topic: str) -> str:
        for reader in self.readers:
            if topic in reader.channels:
                raw = next(reader.messages([topic]), None)
                if raw is not None:
                    items = PartCounter(reader.read_limits.max_items)
                    return str(_payload(reader, raw, items).frame_id)
        return ""


def _copy_records(payload: Cut | Merge) -> tuple[Cut | MergedLog, ...]:
    return payload.logs if isinstance(payload, Merge) else (payload,)


def _payload(reader: LogReader, raw: RawMessage, items: PartCounter) -> Any:
    """Decode a message; its error names the log, the topic and the time."""
    where = f"{reader.path}: {raw.topic} at {raw.log_time_ns} ns"
    if max(raw.log_time_ns, raw.publish_time_ns) >= _LATEST_NS:
        raise LogError(f"{where}: its time is later than the year 2262; the clock of its recorder was wrong")
    try:
        return _decode(reader, reader.channels[raw.topic], raw.data, items)
    except BoundError as error:
        raise BoundError(f"{where}: {error}") from error
    except LogError as error:
        raise LogError(f"{where}: {error}") from error


def _decode(reader: LogReader, channel: StoredChannel, data: bytes, items: PartCounter) -> Any:
    schema = channel.schema
    if schema is None:
        return decode("", data, channel.message_encoding)
    image = payload_type(schema.name) in IMAGES.payloads
    if image:
        items.take(_ITEMS_OF_IMAGE)
    elif len(data) > reader.read_limits.max_structured:
        raise BoundError(_too_large(data))
    definition = schema.data if schema.encoding == "ros2msg" else b""
    return decode(schema.name, data, channel.message_encoding, definition, items)


def _too_large(data: bytes | memoryview) -> str:
    return f"a message of {len(data)} bytes is refused: only images may be so large"
