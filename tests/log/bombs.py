"""Small files that cost much time or memory. None is larger than 1 MB."""

import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.engine.output import write_log
from ipsys_log.log.codec import encode, schema_data, schema_name
from ipsys_log.log.contents import Contents
from ipsys_log.log.records import ENTRY, HEADER, INDEX_HEAD, MAGIC, MESSAGE, ChunkRef, chunk_head, to_bytes
from ipsys_log.log.summary import tail_bytes
from ipsys_log.messages import (
    CameraCalibration,
    CameraPoints,
    CompressedImage,
    Distance,
    Event,
    Marker,
    Markers,
    Measurement,
    Message,
    Position,
    Positions,
    RawImage,
    ReferencePoint,
    Rig,
    Run,
    Track,
    Tracks,
)

MIB = 1 << 20
CORNERS_PX = np.array([(1.0, 1.0), (9.0, 1.0), (9.0, 9.0), (1.0, 9.0)])
Rows = list[tuple[int, int]]


def message(data: bytes, time_ns: int = 0, channel: int = 1) -> bytes:
    length = MESSAGE.size - HEADER.size + len(data)
    return MESSAGE.pack(Opcode.MESSAGE, length, channel, 0, time_ns, time_ns) + data


def compress(name: str, data: bytes) -> bytes:
    if name == "zstd":
        return zstandard.ZstdCompressor(level=3).compress(data)
    return lz4.frame.compress(data, block_size=7) if name else data


@dataclass
class Attack:
    """A builder of logs, valid or as damaged as an attack needs."""

    contents: Contents = field(default_factory=Contents)
    data: bytearray = field(default_factory=lambda: bytearray(MAGIC + to_bytes(mcap.Header("", ""))))

    def channel(
        self, payload: type | str, topic: str, encoding: str = "protobuf", definition: bytes = b""
    ) -> int:
        """Define a channel outside of chunks and in the summary."""
        number = len(self.contents.channels) + 1
        name = payload if isinstance(payload, str) else schema_name(payload)
        data = definition or (b"" if isinstance(payload, str) else schema_data(name))
        kind = {"cdr": "ros2msg", "json": "jsonschema"}.get(encoding, "protobuf")
        schema = mcap.Schema(data=data, encoding=kind, id=number, name=name)
        record = mcap.Channel(
            id=number, message_encoding=encoding, metadata={}, schema_id=number, topic=topic
        )
        self.contents.schemas[number], self.contents.channels[number] = schema, record
        self.data += to_bytes(schema, record)
        return number

    def chunk(
        self,
        content: bytes,
        rows: Rows | None = None,
        *,
        name: str = "zstd",
        span: tuple[int, int] = (0, 0),
        packed: bytes = b"",
        size: int = -1,
        count: int = 1,
        crc: int = 0,
    ) -> None:
        """Add a chunk; with `rows` a message index of channel 1, else none; `count` of them in Statistics."""
        packed = packed or compress(name, content)
        size = len(content) if size < 0 else size
        offset = len(self.data)
        record = chunk_head(*span, size, crc, name, len(packed)) + packed
        indexes, offsets = b"", {}
        if rows is not None:
            body = b"".join(ENTRY.pack(*row) for row in rows)
            indexes = INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(body), 1, len(body)) + body
            offsets = {1: offset + len(record)}
            count = len(rows)
        self.data += record + indexes
        self.contents.chunks.append(
            ChunkRef(offset, len(record), *span, name, len(packed), size, len(indexes), offsets)
        )
        if count:
            self.contents.count(1, count)
            self.contents.cover(*span)

    def finish(self, summary: bool = True) -> bytes:
        self.contents.data_end = len(self.data)
        if summary:
            return bytes(self.data) + tail_bytes(self.contents)
        end = struct.pack("<BQI", Opcode.DATA_END, 4, 0)
        return bytes(self.data) + end + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0) + MAGIC


IMAGES, POINTS = "/cameras/a/image", "/runs/r/cameras/a/camera_points"


def zeros(compression: str, size: int, times: int, summary: bool) -> bytes:
    attack = Attack()
    attack.channel(CompressedImage, IMAGES)
    packed = compress(compression, bytes(size))
    for _ in range(times):
        attack.chunk(b"", name=compression, packed=packed, size=size)
    return attack.finish(summary)


def large_messages(size: int, times: int, indexed: bool, overlap: bool, payload: bytes = b"") -> bytes:
    attack = Attack()
    attack.channel(CompressedImage, IMAGES)
    payload = payload or encode(CompressedImage(0, "a", b"\xff\xd8\xff" + bytes(size), "jpeg"))
    for number in range(times):
        content = message(payload, number)
        span = (0, times) if overlap else (number, number)
        attack.chunk(content, [(number, 0)] if indexed else None, span=span)
    return attack.finish(indexed)


def tiny_records(record: bytes, times: int, chunks: int) -> bytes:
    attack = Attack()
    attack.channel(Event, "/events")
    content = record * times
    packed = compress("zstd", content)
    for _ in range(chunks):
        attack.chunk(content, packed=packed, count=times if record[0] == Opcode.MESSAGE else 0)
    return attack.finish(False)


def empty_messages(payload: bytes, kind: type, topic: str, times: int, chunks: int, indexed: bool) -> bytes:
    attack = Attack()
    attack.channel(kind, topic)
    start = 0
    for _ in range(chunks):
        content = bytearray()
        rows: Rows = []
        for number in range(times):
            rows.append((start + number, len(content)))
            content += message(payload, start + number)
        attack.chunk(bytes(content), rows if indexed else None, span=(start, start + times - 1), count=times)
        start += times
    return attack.finish()


def of_run(number: int, stage: str, payload: Markers | Positions, name: str) -> bytes:
    """Write one message of a run very often, with the record that makes it a run."""
    topic = f"/runs/r/cameras/a/{name}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        run = Message("/runs/r/record", number, number, Run(number, "r", stage, number=1))
        write_log(path, [*(Message(topic, n, n, payload, "a") for n in range(number)), run])
        return path.read_bytes()


def many_robots(number: int) -> bytes:
    """Write tracks, each of a separate robot."""
    attack = Attack()
    attack.channel(Tracks, "/truth/tracks")
    content, rows = bytearray(), []
    for n in range(number):
        rows.append((n, len(content)))
        content += message(encode(Tracks(n, (Track(str(n), 1, 0.0, 0.0, 0.0),))), n)
    attack.chunk(bytes(content), rows, span=(0, number - 1), count=number)
    return attack.finish()


def lost_channels(number: int) -> bytes:
    """Write messages outside of chunks, each of an undefined channel."""
    messages = (to_bytes(mcap.Message(n + 1, n, b"", n, n)) for n in range(number))
    return MAGIC + to_bytes(mcap.Header("", "")) + b"".join(messages)


def with_rig(measurements: list[bytes]) -> bytes:
    """Write measurements that each need least squares."""
    attack = Attack()
    attack.channel(Measurement, "/measurements")
    content, rows = bytearray(), []
    for number, payload in enumerate(measurements):
        rows.append((number, len(content)))
        content += message(payload, number)
    attack.chunk(bytes(content), rows, span=(0, len(rows)))
    points = tuple(ReferencePoint(name, x, x * x) for name, x in zip("ABC", (0.0, 1.0, 2.0), strict=True))
    rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points)
    channel = attack.channel(Rig, "/rig")
    attack.chunk(message(encode(rig), 0, channel), span=(0, 0), count=0)
    attack.contents.counts[channel] = 1
    return attack.finish()


def same_message_again(times: int, size: int) -> bytes:
    """Write one message index, all of whose entries point to one large message."""
    attack = Attack()
    attack.channel(CompressedImage, IMAGES)
    content = message(encode(CompressedImage(0, "a", b"\xff\xd8\xff" + bytes(size), "jpeg")))
    attack.chunk(content, [(0, 0)] * times)
    return attack.finish()


def nested_messages(times: int, size: int) -> bytes:
    """Write messages whose payload contains all later messages."""
    attack = Attack()
    attack.channel(CompressedImage, IMAGES)
    whole = times * MESSAGE.size + size
    content = bytearray()
    for number in range(times):
        length = whole - len(content) - HEADER.size
        content += MESSAGE.pack(Opcode.MESSAGE, length, 1, 0, number, number)
    content += bytes(size)
    rows = [(number, number * MESSAGE.size) for number in range(times)]
    attack.chunk(bytes(content), rows, span=(0, times))
    return attack.finish()


def many_channels(number: int, chunked: bool) -> bytes:
    attack = Attack()
    if chunked:
        records = (
            mcap.Channel(id=n, topic=f"{n}", message_encoding="", metadata={}, schema_id=0)
            for n in range(1, number + 1)
        )
        attack.chunk(b"".join(to_bytes(record) for record in records), count=0)
        return attack.finish(False)
    for n in range(1, number + 1):
        attack.contents.channels[n] = mcap.Channel(
            id=n, topic=f"{n}", message_encoding="", metadata={}, schema_id=0
        )
    return attack.finish()


def many_cameras(number: int) -> bytes:
    attack = Attack()
    schema = mcap.Schema(data=b"", encoding="protobuf", id=1, name="foxglove.CameraCalibration")
    attack.contents.schemas[1] = schema
    for n in range(1, number + 1):
        attack.contents.channels[n] = mcap.Channel(
            id=n, topic=f"/c{n}/info", message_encoding="protobuf", metadata={}, schema_id=1
        )
    content = b"".join(message(b"", n, n) for n in range(1, number + 1))
    attack.chunk(content, count=0, span=(1, number))
    attack.contents.counts = dict.fromkeys(range(1, number + 1), 1)
    return attack.finish()


def many_chunks(number: int) -> bytes:
    attack = Attack()
    attack.channel(Event, "/events")
    content = message(b"", 0)
    for _ in range(number):
        attack.chunk(content, [(0, 0)], name="")
    return attack.finish()


def large_definition(size: int, name: str = "ipsys.v1.Event") -> bytes:
    attack = Attack()
    records = to_bytes(
        mcap.Schema(data=bytes(size), encoding="protobuf", id=1, name=name),
        mcap.Channel(id=1, topic="/events", message_encoding="protobuf", metadata={}, schema_id=1),
    )
    attack.chunk(records + message(b""))
    return attack.finish(False)


def many_elements(kind: type, field_number: int, element: bytes, times: int, messages: int) -> bytes:
    """Write messages with a repeated field of very many small elements."""
    attack = Attack()
    topic = {CameraPoints: POINTS, Markers: "/runs/r/cameras/a/markers", Run: "/runs/r/record"}.get(
        kind, "/m"
    )
    attack.channel(kind, topic)
    payload = (bytes([field_number << 3 | 2, len(element)]) + element) * times
    for number in range(messages):
        attack.chunk(message(payload, number), [(number, 0)], span=(number, number))
    return attack.finish()


def chunk_heads(number: int) -> bytes:
    """Write many byte sequences that look like the start of a large chunk, after damage."""
    attack = Attack()
    attack.channel(CompressedImage, IMAGES)
    packed = compress("zstd", bytes(16 * MIB))
    tail = bytes(attack.data) + bytes(20)
    parts = []
    total = number * 57 + len(packed)
    for n in range(number):
        parts.append(chunk_head(0, 0, 16 * MIB, 0, "zstd", total - (n + 1) * 57)[:57])
    return tail + b"".join(parts) + packed


def real_chunk_heads(number: int) -> bytes:
    """Write many large chunks, each after damage."""
    attack = Attack()
    attack.channel(CompressedImage, IMAGES)
    packed = compress("zstd", bytes(16 * MIB))
    piece = chunk_head(0, 0, 16 * MIB, 1, "zstd", len(packed)) + packed
    return bytes(attack.data) + (piece + bytes(20)) * number


def metadata(number: int) -> bytes:
    attack = Attack()
    record = to_bytes(mcap.Metadata(name="ipsys", metadata={}))
    attack.data += record * number
    return attack.finish(False)


def json_deep(depth: int) -> bytes:
    attack = Attack()
    attack.channel("foxglove.CameraCalibration", "/a/calibration", "json")
    attack.chunk(message(b'{"a":' * depth + b"1" + b"}" * depth), [(0, 0)])
    return attack.finish()


def json_wide(times: int) -> bytes:
    attack = Attack()
    attack.channel("foxglove.CameraCalibration", "/a/calibration", "json")
    attack.chunk(message(b'{"a":[' + b"{}," * times + b"1]}"), [(0, 0)])
    return attack.finish()


def ros_definition(definition: bytes, payload: bytes, kind: str = "CameraInfo") -> bytes:
    attack = Attack()
    attack.channel(f"sensor_msgs/msg/{kind}", "/a/camera_info", "cdr", definition)
    attack.chunk(message(payload), [(0, 0)])
    return attack.finish()


def raw_image(width: int, height: int, data: bytes, times: int) -> bytes:
    attack = Attack()
    attack.channel(RawImage, IMAGES)
    payload = encode(RawImage(0, "a", width, height, "mono8", width, data))
    for number in range(times):
        attack.chunk(message(payload, number), [(number, 0)], span=(number, number))
    return attack.finish()


def jpeg_head(width: int, height: int) -> bytes:
    """Return a JPEG of one grey pixel with a larger size in its header."""
    import cv2
    import numpy as np

    data = bytearray(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def images(data: bytes, times: int) -> bytes:
    return large_messages(0, times, True, False, encode(CompressedImage(0, "a", data, "jpeg")))


_RECURSIVE = b"bad_type x\nstd_msgs/Header header\n" + b"=" * 80 + b"\nMSG: std_msgs/Header\nuint32 a\n"
_EMPTY_ITEMS = b"a/E[] items\n" + b"=" * 80 + b"\nMSG: a/E\n\n"

TAPES = (Distance("A", 1.5), Distance("B", 1.2), Distance("C", 3.0))

BOMBS: dict[str, Callable[[], bytes]] = {
    "one chunk of 1 GiB, zstd": lambda: zeros("zstd", 1 << 30, 1, True),
    "one chunk of 1 GiB, zstd, no summary": lambda: zeros("zstd", 1 << 30, 1, False),
    "one chunk of 255 MiB, zstd, no summary": lambda: zeros("zstd", 255 * MIB, 1, False),
    "one chunk of 240 MB, lz4, no summary": lambda: zeros("lz4", 240_000_000, 1, False),
    "60 chunks of 16 MiB, zstd": lambda: zeros("zstd", 16 * MIB, 60, False),
    "1800 chunks of 16 MiB, zstd": lambda: zeros("zstd", 16 * MIB, 1800, False),
    "60 messages of 16 MiB": lambda: large_messages(16 * MIB - 100, 60, True, False),
    "60 messages of 16 MiB at one time": lambda: large_messages(16 * MIB - 100, 60, True, True),
    "one message of 127 MiB": lambda: large_messages(127 * MIB, 1, True, False),
    "7 M private records": lambda: tiny_records(HEADER.pack(0x80, 0), 16 * MIB // 9, 4),
    "private records, 100 kB of them each": lambda: tiny_records(HEADER.pack(0x80, 0), 11_000, 1500),
    "2 M messages without payload": lambda: tiny_records(message(b""), 16 * MIB // 31, 4),
    "300 k messages, not indexed": lambda: empty_messages(b"", Event, "/events", 1000, 300, False),
    "55 k events": lambda: empty_messages(b"", Event, "/events", 1000, 50, True),
    "55 k sightings of nothing": lambda: empty_messages(
        b"", Markers, "/runs/r/cameras/a/markers", 1000, 50, True
    ),
    "55 k images": lambda: empty_messages(
        encode(CompressedImage(0, "a", b"\xff\xd8\xff", "jpeg")), CompressedImage, IMAGES, 1000, 45, True
    ),
    "40 k calibrations": lambda: empty_messages(
        encode_calibration(), CameraCalibration, "/cameras/a/calibration", 1000, 40, True
    ),
    "40 k runs": lambda: empty_messages(b"", Run, "/runs/r/record", 1000, 40, True),
    "40 k measurements": lambda: empty_messages(b"", Measurement, "/measurements", 1000, 40, True),
    "40 k tracks": lambda: empty_messages(
        encode(Tracks(0, (Track("a", 1, 0.0, 0.0, 0.0),))), Tracks, "/truth/tracks", 1000, 40, True
    ),
    "20 k tapes": lambda: with_rig(
        [encode(Measurement(0, str(n), None, 1, TAPES, None, 0.1)) for n in range(20_000)]
    ),
    "35 k markers": lambda: of_run(35_000, "detect", Markers(0, (Marker(7, CORNERS_PX),), 64, 48), "markers"),
    "35 k positions": lambda: of_run(
        35_000, "locate", Positions(0, (Position(7, 1.0, 2.0, 0.1),)), "positions"
    ),
    "tracks of a new robot in each message": lambda: many_robots(20_000),
    "messages of 30 k lost channels": lambda: lost_channels(30_000),
    "one message 50 k times": lambda: same_message_again(50_000, 15 * MIB),
    "10 k nested messages": lambda: nested_messages(10_000, 15 * MIB),
    "65 k channels in a chunk": lambda: many_channels(65_000, True),
    "30 k channels": lambda: many_channels(30_000, False),
    "8 k cameras": lambda: many_cameras(8000),
    "5000 chunks at one time": lambda: many_chunks(5000),
    "a definition of 15 MiB": lambda: large_definition(15 * MIB),
    "a definition of 120 MiB": lambda: large_definition(120 * MIB),
    "7 M camera points": lambda: many_elements(CameraPoints, 2, b"", 7 * MIB, 1),
    "500 k camera points, 60 times": lambda: many_elements(CameraPoints, 2, b"", 500_000, 60),
    "7 M markers": lambda: many_elements(Markers, 4, b"", 7 * MIB, 1),
    "chunk heads behind damage": lambda: chunk_heads(15_000),
    "large chunks behind damage": lambda: real_chunk_heads(1500),
    "50 k metadata records": lambda: metadata(40_000),
    "JSON 200 k deep": lambda: json_deep(200_000),
    "JSON of 5 M objects": lambda: json_wide(5_000_000),
    "ROS 2 definition with empty items": lambda: ros_definition(_EMPTY_ITEMS, b"\0\1\0\0" + b"\xff" * 4),
    "raw images of 15 MiB": lambda: raw_image(4096, 3840, bytes(15 * MIB), 60),
    "JPEG of 65500 x 65500": lambda: images(jpeg_head(65500, 65500), 20),
}


def encode_calibration() -> bytes:
    import numpy as np

    K = np.diag([500.0, 500.0, 1.0])
    P = np.hstack([K, np.zeros((3, 1))])
    return encode(CameraCalibration(0, "a", 960, 540, "kannala_brandt", np.zeros(4), K, np.eye(3), P))
