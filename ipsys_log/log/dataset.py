"""One or several logs as one stream of decoded messages, from any recorder.

Own logs name their cameras in their topics. In the logs of others, images and calibrations are
known by their schema, and a camera's name is made from the topic or the frame they share.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import LogError
from ipsys_log.log.bounds import BoundError, PartCounter
from ipsys_log.log.codec import decode, payload_type
from ipsys_log.log.contents import (
    RawMessage,
    StoredChannel,
    camera_of_topic,
    clean_name,
    parse_foreign_camera,
    run_of_topic,
)
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import Measurement, Message, Run
from ipsys_log.messages.channels import (
    CALIBRATIONS,
    IMAGES,
    MEASUREMENTS_TOPIC,
    Channel,
    channel_of,
)

__all__ = ["Session", "find_new_ids", "rename_ids"]


def find_new_ids(logs: Iterable[Iterable[Measurement]]) -> list[dict[str, str]]:
    """New ids where an earlier log has the same: for each log, the new one by the old one.

    Parameters
    ----------
    logs : the measurements of each log; the earliest log first.

    Examples
    --------
    >>> find_new_ids([[Measurement(0, "p001")], [Measurement(9, "p001"), Measurement(9, "p002")]])
    [{}, {'p001': 'p001_2'}]
    """
    taken: set[str] = set()
    found = []
    for number, measurements in enumerate(logs, 1):
        here = list(dict.fromkeys(one.id for one in measurements))
        new: dict[str, str] = {}
        for name in here:
            if name in taken:
                new[name] = f"{name}_{number}"
        taken.update(new.get(name, name) for name in here)
        found.append(new)
    return found


def rename_ids(measurement: Measurement, ids: Mapping[str, str]) -> Measurement:
    """A measurement, or the end of one, under the new ids of its log."""
    withdrawn = measurement.withdraws
    return replace(
        measurement,
        id=ids.get(measurement.id, measurement.id),
        withdraws=None if withdrawn is None else ids.get(withdrawn, withdrawn),
    )


_ITEMS_OF_IMAGE = 16
_LATEST_NS = 1 << 63


class Session:
    """Open logs, read together in log order. A context manager.

    Where measurements of two logs have one id, that of the later log gets another, such as ``p001_2``.

    Parameters
    ----------
    paths : the logs; where two hold messages of one time, the earlier one's come first.

    Attributes
    ----------
    images, calibrations : topic by camera.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = list(paths)
        self._stack = ExitStack()
        self._channels: dict[tuple[str, str], Channel | None] = {}
        try:
            self.readers = [self._stack.enter_context(LogReader(path)) for path in paths]
            self._check_numbers()
            self._check_overlaps()
            self.images = self._cameras(IMAGES)
            self.calibrations = self._pair_calibrations(self._cameras(CALIBRATIONS))
            self._camera_of = {
                topic: name for topics in (self.images, self.calibrations) for name, topic in topics.items()
            }
            self._ids: dict[LogReader, dict[str, str]] = {}
            self._ids = self._find_new_ids()
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def __str__(self) -> str:
        return ", ".join(str(path) for path in self.paths)

    @property
    def start_ns(self) -> int:
        return min((r.start_ns for r in self.readers if r.start_ns is not None), default=0)

    @property
    def end_ns(self) -> int:
        return max((r.end_ns for r in self.readers if r.end_ns is not None), default=0)

    def topics(self, channel: Channel, run: str | None = None) -> list[str]:
        """Return the topics of a channel that have messages: of one run, or with None outside of all runs."""
        return sorted(
            {
                topic
                for reader in self.readers
                for topic, stored in reader.channels.items()
                if stored.message_count > 0
                and self._channel_of(topic, stored) is channel
                and run_of_topic(topic) == run
            }
        )

    def _channel_of(self, topic: str, stored: StoredChannel) -> Channel | None:
        schema = stored.schema.name if stored.schema is not None else ""
        key = topic, schema
        if key not in self._channels:
            self._channels[key] = channel_of(topic, payload_type(schema) if schema else None)
        return self._channels[key]

    def last(self, topics: Collection[str]) -> tuple[int, int]:
        """Log time and publish time of the last message of some topics; the start where there is none."""
        found = [(times[-1], r, t) for r in self.readers for t in topics if len(times := _times(r, t))]
        if not found:
            return self.start_ns, self.start_ns
        last_ns, reader, topic = max(found, key=lambda item: item[0])
        *_, message = reader.messages([topic], start_ns=int(last_ns))
        return message.log_time_ns, message.publish_time_ns

    def run_names(self) -> set[str]:
        """Every run that has a channel, complete or not."""
        return {run for reader in self.readers for topic in reader.channels if (run := run_of_topic(topic))}

    def unread_images(self) -> list[str]:
        """Topics that look like images, but are of a schema that is not read here."""
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
        """Hash of a channel's messages, the same in whichever file they lie; one for each of several."""
        parts = [r for r in self.readers if len(_times(r, topic))]
        # In the order of their times, not in that of the command line.
        return "+".join(r.channel_hash(topic) for r in sorted(parts, key=lambda r: int(_times(r, topic)[0])))

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the decoded messages of some topics in log order, from ``start_ns`` to before ``end_ns``.

        Raises
        ------
        LogError
            A message does not match the schema of its channel; the text names topic and file.
        """
        streams = [self._decoded(reader, items, topics, start_ns, end_ns) for reader, items in self._items()]
        return heapq.merge(*streams, key=lambda message: message.log_time_ns)

    def stored(self, topics: Collection[str]) -> Iterator[tuple[Message, bytes]]:
        """Yield the same as :meth:`messages`, each with the encoded bytes of its payload."""
        streams = [self._stored(reader, items, topics) for reader, items in self._items()]
        return heapq.merge(*streams, key=lambda row: row[0].log_time_ns)

    def _stored(
        self, reader: LogReader, items: PartCounter, topics: Collection[str]
    ) -> Iterator[tuple[Message, bytes]]:
        for raw in self._raw(reader, topics, None, None):
            yield self._message(reader, raw, items), bytes(raw.data)

    def _raw(
        self, reader: LogReader, topics: Collection[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        here = [topic for topic in topics if topic in reader.channels]
        return reader.messages(here, start_ns, end_ns) if here else iter(())

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
        camera = self._camera_of.get(raw.topic) or camera_of_topic(raw.topic)
        # Who records ROS 2 knows when a message came; when its frame was taken stands within.
        taken_ns = payload.timestamp if channel.message_encoding == "cdr" else 0
        return Message(raw.topic, raw.log_time_ns, taken_ns or raw.publish_time_ns, payload, camera)

    def payloads(self, topics: Collection[str]) -> list[Any]:
        return [message.payload for message in self.messages(topics)]

    def runs(self) -> list[Run]:
        """Return the records of the stages, oldest first: in the order of the given logs, then by number."""
        return [run for reader, items in self._items() for run in self._runs_in(reader, items)]

    def _runs_in(self, reader: LogReader, items: PartCounter) -> list[Run]:
        topics = [
            topic
            for topic, stored in reader.channels.items()
            if stored.schema is not None and payload_type(stored.schema.name) is Run
        ]
        found = [message.payload for message in self._decoded(reader, items, topics, None, None)]
        return sorted(found, key=lambda run: run.number)

    def _find_new_ids(self) -> dict[LogReader, dict[str, str]]:
        """Return the ids of measurements that an earlier log has too, and their ids here."""
        readers = [reader for reader in self.readers if len(_times(reader, MEASUREMENTS_TOPIC))]
        if len(readers) < 2:
            return {}
        readers.sort(key=lambda reader: int(_times(reader, MEASUREMENTS_TOPIC)[0]))
        found = find_new_ids(
            [
                one.payload
                for one in self._decoded(
                    reader, PartCounter(reader.read_limits.max_items), [MEASUREMENTS_TOPIC], None, None
                )
                if isinstance(one.payload, Measurement)
            ]
            for reader in readers
        )
        return dict(zip(readers, found, strict=True))

    def _check_numbers(self) -> None:
        """Refuse more runs or measurements than a lab has: each costs a line, or an equation."""
        for reader in self.readers:
            for payload, what in ((Run, "runs"), (Measurement, "measurements")):
                counts = [
                    channel.message_count
                    for channel in reader.channels.values()
                    if channel.schema is not None and payload_type(channel.schema.name) is payload
                ]
                reader.check_number(sum(counts), what)

    def _check_overlaps(self) -> None:
        """Logs that follow one another are one; two that speak at once of one thing are not."""
        images = set(self.topics(IMAGES))
        first: dict[str, LogReader] = {}
        for reader in self.readers:
            for topic in reader.channels:
                other = first.setdefault(topic, reader)
                if other is reader or topic.endswith("/record"):
                    continue
                if topic in images and _overlap(reader, other, topic):
                    raise LogError(
                        f"two cameras of one name: {topic} is in {other.path} and, at the same time, in "
                        f"{reader.path}; leave one of them out"
                    )
                if run_of_topic(topic) is not None:
                    raise LogError(
                        f"{topic} is in {other.path} and in {reader.path}; leave one of them out, or make "
                        "that run again with --run and another name"
                    )

    def _cameras(self, channel: Channel) -> dict[str, str]:
        """Return the topic by camera; if a camera has topics of several types, that of the first type."""
        cameras: dict[str, str] = {}
        for payload in channel.payloads:
            topics = [topic for topic in self.topics(channel) if self._has_payload(topic, payload)]
            names = [camera_of_topic(topic) or parse_foreign_camera(topic) for topic in topics]
            found: dict[str, str] = {}
            for topic, name in zip(topics, names, strict=True):
                # Topics that differ only in words such as color or mono keep these words.
                camera = name if names.count(name) == 1 else clean_name(topic)
                if camera in found:
                    raise LogError(
                        f"{self}: two cameras of one name, {camera!r}: {found[camera]} and {topic}; "
                        "rename one of the topics"
                    )
                found[camera] = topic
            cameras = found | cameras
        return cameras

    def _has_payload(self, topic: str, payload: type) -> bool:
        stored = (reader.channels[topic] for reader in self.readers if topic in reader.channels)
        return any(one.schema is not None and payload_type(one.schema.name) is payload for one in stored)

    def _pair_calibrations(self, found: dict[str, str]) -> dict[str, str]:
        """Give each calibration the name of its camera: by topic, else by a shared frame."""
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
        raise BoundError(f"a message of {len(data)} bytes is refused: only images may be so large")
    definition = schema.data if schema.encoding == "ros2msg" else b""
    return decode(schema.name, data, channel.message_encoding, definition, items)


def _times(reader: LogReader, topic: str) -> NDArray[np.int64]:
    return reader.times(topic) if topic in reader.channels else np.empty(0, np.int64)


def _overlap(one: LogReader, other: LogReader, topic: str) -> bool:
    first, second = one.times(topic), other.times(topic)
    return bool(len(first) and len(second) and first[0] <= second[-1] and second[0] <= first[-1])
