"""Cost of writing a log, compared with the ``mcap`` package and foxglove-sdk in the same run.

    python benchmarks/log_write.py --write-seconds 20

Images: three cameras at 30/s with frames of 300 kB, random bytes as incompressible as JPEG. ``recorder``
works like a recorder: it encodes and writes payloads, and flushes every second. Its share of a core is its
processor time, with that of the kernel, divided by the duration of the stream. The other writers, and
ipsys once more, get the same bytes already encoded; chunks of 4 MiB, uncompressed. Small messages: about
120 bytes on nine channels, encoded; each writer uses its own default chunks and compression (all zstd).
All times are processor times.
"""

from __future__ import annotations

import argparse
import random
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from results import Report, command
from rounds import Contender, Row, Turn, race, ratio_row
from scenes import CACHE

from ipsys_log.log.codec import encode, schema_data
from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import CompressedImage

__all__ = ["measure"]

IMAGE_BYTES = 300_000
CAMERAS = ("red", "white", "black")
RATE_HZ = 30
CHANNELS = 9
_DIFFERENT = 30
_EPOCH_NS = 1_700_000_000_000_000_000

# Its arguments are channel, log time and publish time in ns, and the bytes of a message.
Put = Callable[[int, int, int, bytes], None]


def _opened(
    kind: str, path: Path, schema: str, topics: list[str], images: bool
) -> tuple[Put, Callable[[], Any]]:
    """Return the functions of a writer on a new file: one writes a message, one finishes the file."""
    return {"ours": _ours, "mcap": _mcap, "foxglove": _foxglove}[kind](path, schema, topics, images)


def _ours(path: Path, schema: str, topics: list[str], _images: bool) -> tuple[Put, Callable[[], Any]]:
    writer = LogWriter.create(path)
    for topic in topics:
        writer.add_channel(topic, Schema(schema, "protobuf", schema_data(schema)))
    write = writer.write

    def put(channel: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        write(topics[channel], log_ns, publish_ns, data)

    return put, writer.close


def _mcap(path: Path, schema: str, topics: list[str], images: bool) -> tuple[Put, Callable[[], Any]]:
    from mcap.writer import CompressionType, Writer

    options: dict[str, Any] = {"chunk_size": 4 << 20, "compression": CompressionType.NONE} if images else {}
    file = path.open("wb")
    writer = Writer(file, **options)
    writer.start()
    schema_id = writer.register_schema(schema, "protobuf", schema_data(schema))
    ids = [writer.register_channel(topic, "protobuf", schema_id) for topic in topics]

    def put(channel: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        writer.add_message(ids[channel], log_ns, data, publish_ns)

    def finish() -> None:
        writer.finish()  # type: ignore[no-untyped-call]
        file.close()

    return put, finish


def _foxglove(path: Path, schema: str, topics: list[str], images: bool) -> tuple[Put, Callable[[], Any]]:
    import foxglove
    from foxglove.mcap import MCAPWriteOptions

    options = MCAPWriteOptions(chunk_size=4 << 20, compression=None) if images else MCAPWriteOptions()
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context, writer_options=options)
    described = foxglove.Schema(name=schema, encoding="protobuf", data=schema_data(schema))
    logs = [
        foxglove.Channel(topic, schema=described, message_encoding="protobuf", context=context).log
        for topic in topics
    ]

    def put(channel: int, log_ns: int, _publish_ns: int, data: bytes) -> None:
        logs[channel](data, log_time=log_ns)  # foxglove-sdk has no publish time

    def finish(_kept: Any = context) -> None:  # its channels close with the context
        writer.close()

    return put, finish


def _frames() -> list[CompressedImage]:
    chance = random.Random(1)
    return [CompressedImage(0, "red", chance.randbytes(IMAGE_BYTES), "jpeg") for _ in range(_DIFFERENT)]


def _images(folder: Path, kind: str, seconds: int) -> Turn:
    """Return a turn that writes a stream of the given duration."""
    path = folder / f"{kind}.mcap"
    path.unlink(missing_ok=True)
    ready = [encode(frame) for frame in _frames()]
    topics = [f"/cameras/{camera}/image" for camera in CAMERAS]

    def turn(_number: int) -> int:
        put, finish = _opened(kind, path, "foxglove.CompressedImage", topics, True)
        for index in range(seconds * RATE_HZ):
            now_ns = _EPOCH_NS + index * 1_000_000_000 // RATE_HZ
            for camera in range(len(CAMERAS)):
                put(camera, now_ns + camera + 4_000_000, now_ns, ready[(index + camera) % _DIFFERENT])
        finish()
        return path.stat().st_size

    return turn


def _recorder(folder: Path, seconds: int) -> Turn:
    """Return a turn that also encodes, and that syncs to the disk every second."""
    path = folder / "recorder.mcap"
    path.unlink(missing_ok=True)
    frames = _frames()

    def turn(_number: int) -> int:
        with LogWriter.create(path) as writer:
            for camera in CAMERAS:
                schema = Schema(
                    "foxglove.CompressedImage", "protobuf", schema_data("foxglove.CompressedImage")
                )
                writer.add_channel(f"/cameras/{camera}/image", schema)
            for index in range(seconds * RATE_HZ):
                now_ns = _EPOCH_NS + index * 1_000_000_000 // RATE_HZ
                for number, camera in enumerate(CAMERAS):
                    data = frames[(index + number) % _DIFFERENT].data
                    frame = CompressedImage(now_ns, camera, data, "jpeg")
                    writer.write(
                        f"/cameras/{camera}/image", now_ns + number + 4_000_000, now_ns, encode(frame)
                    )
                if index % RATE_HZ == RATE_HZ - 1:
                    writer.flush()
        return path.stat().st_size

    return turn


def _small(folder: Path, kind: str, messages: int) -> Turn:
    """Return a turn that writes small messages on nine channels, like the channels of a stage."""
    path = folder / f"{kind}.mcap"
    path.unlink(missing_ok=True)
    chance = random.Random(2)
    # Half noise, half zeros and names: about as compressible as numbers.
    ready = [chance.randbytes(60) + b"camera" * 10 for _ in range(999)]
    topics = [f"/runs/stock/cameras/c{number}/markers" for number in range(CHANNELS)]

    def turn(_number: int) -> int:
        put, finish = _opened(kind, path, "ipsys.v1.Markers", topics, False)
        for index in range(messages):
            now_ns = _EPOCH_NS + index * 1_000_000_000 // (RATE_HZ * CHANNELS)
            put(index % CHANNELS, now_ns, now_ns - 4_000_000, ready[index % 999])
        finish()
        return path.stat().st_size

    return turn


def _check(folder: Path, kinds: Sequence[str], messages: int) -> None:
    """Check that each writer has written all messages: otherwise its speed means nothing."""
    for kind in kinds:
        with LogReader(folder / f"{kind}.mcap") as log:
            if log.message_count != messages:
                raise SystemExit(f"{kind} wrote {log.message_count} messages of {messages}")


def measure(options: argparse.Namespace) -> Report:
    """Measure images, then small messages."""
    report = Report("log_write")
    seconds, messages = (1, 2_000) if options.smoke else (options.write_seconds, options.write_messages)
    kinds = ("ours", "mcap", "foxglove")
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as name:
        folder = Path(name)
        images = [Contender(kind, _images, (folder, kind, seconds)) for kind in kinds]
        large = race([Contender("recorder", _recorder, (folder, seconds)), *images], 1, options.rounds)
        _check(folder, ("recorder", *kinds), seconds * RATE_HZ * len(CAMERAS))
        small = race([Contender(kind, _small, (folder, kind, messages)) for kind in kinds], 1, options.rounds)
        _check(folder, kinds, messages)
    rows = report.rows
    rows.append(ratio_row("small messages: mcap / ours", small["mcap"], small["ours"], (">=", 1.0)))
    rows.append(ratio_row("small messages: foxglove / ours", small["foxglove"], small["ours"]))
    rows.append(ratio_row("images: mcap / ours", large["mcap"], large["ours"]))
    rows.append(ratio_row("images: foxglove / ours", large["foxglove"], large["ours"]))
    share = tuple(100 * cpu_s / seconds for cpu_s in large["recorder"].cpu_s)
    rows.append(Row("recorder, 3 x 30/s x 300 kB", share, "% core", ("<=", 3.0)))
    for kind in kinds:
        rate = tuple(messages / cpu_s for cpu_s in small[kind].cpu_s)
        rows.append(Row(f"small messages, {kind}", rate, "messages/s"))
    for kind_of_messages, timings in (("images", large), ("small", small)):
        report.details[kind_of_messages] = {
            kind: {"cpu_s": timing.cpu_s, "wall_s": timing.wall_s, "bytes": timing.kept[0]}
            for kind, timing in timings.items()
        }
    report.details["seconds"], report.details["messages"] = seconds, messages
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--write-seconds", type=int, default=20, help="of stream")
    parser.add_argument("--write-messages", type=int, default=100_000, help="small ones")


if __name__ == "__main__":
    command("log_write")
