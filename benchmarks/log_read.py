"""Read speed of messages, headers and payload bytes, against the ``mcap`` package in the same run.

    python benchmarks/log_read.py --gb 1

The first cases are small messages among images, in logs of ``mcap.Writer`` and in one of ipsys. The next
cases are all messages of the ipsys log, and a log of small messages alone. Images are random bytes of
300 kB, as incompressible as JPEG. Both readers run in turns, in separate processes, and must agree. The
files are in the page cache; the time is processor time. A bare ``os.pread`` of the file is the lower limit
for every reader: with images, this alone is about a fifth of the time of ``mcap``.
"""

import argparse
import os
import random
import tempfile
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from results import Report, command
from rounds import Contender, Row, Turn, race, ratio_row
from scenes import CACHE

from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter

IMAGE_BYTES = 300_000
SMALL = 3_000
PERIOD_NS = 33_333_333


def payloads(gigabytes: float) -> tuple[int, list[bytes]]:
    """Return the number of images, and small payloads of about 100 bytes."""
    chance = random.Random(1)
    return int(gigabytes * 1e9 / IMAGE_BYTES), [chance.randbytes(90 + k % 20) for k in range(SMALL)]


def write_foreign(path: Path, gigabytes: float, compression: CompressionType) -> None:
    images, small = payloads(gigabytes)
    chance = random.Random(2)
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "protobuf", b"")
        image = writer.register_channel("/image", "protobuf", schema)
        points = writer.register_channel("/points", "protobuf", writer.register_schema("P", "protobuf", b""))
        sent = 0
        for number in range(images):
            now = number * PERIOD_NS
            writer.add_message(image, now, chance.randbytes(IMAGE_BYTES), now)
            while sent < (number + 1) * SMALL // images:
                writer.add_message(points, now + 1 + sent % 7, small[sent], now)
                sent += 1
        writer.finish()  # type: ignore[no-untyped-call]


def write_own(path: Path, gigabytes: float) -> None:
    images, small = payloads(gigabytes)
    chance = random.Random(2)
    with LogWriter.create(path) as writer:
        writer.add_channel("/image", Schema("foxglove.CompressedImage", "protobuf", b""))
        writer.add_channel("/points", Schema("P", "protobuf", b""))
        sent = 0
        for number in range(images):
            now = number * PERIOD_NS
            writer.write("/image", now, now, chance.randbytes(IMAGE_BYTES))
            while sent < (number + 1) * SMALL // images:
                writer.write("/points", now + 1 + sent % 7, now, small[sent])
                sent += 1


def write_small(path: Path, messages: int) -> None:
    chance = random.Random(3)
    with LogWriter.create(path) as writer:
        writer.add_channel("/points", Schema("P", "protobuf", b""))
        for number in range(messages):
            now = number * PERIOD_NS // 9
            writer.write("/points", now, now, chance.randbytes(90 + number % 20))


def stock(path: Path, topics: list[str] | None) -> Turn:
    def turn(_number: int) -> int:
        with path.open("rb") as file:
            return sum(len(m.data) for _, _, m in make_reader(file).iter_messages(topics=topics))

    return turn


def ours(path: Path, topics: list[str] | None) -> Turn:
    def turn(_number: int) -> int:
        with LogReader(path) as reader:
            return sum(len(message.data) for message in reader.messages(topics))

    return turn


def bare(path: Path, _topics: list[str] | None) -> Turn:
    """Read the bytes of the file and do nothing else."""

    def turn(_number: int) -> int:
        offsets = range(0, path.stat().st_size, IMAGE_BYTES)
        with path.open("rb", buffering=0) as file:
            return sum(len(os.pread(file.fileno(), IMAGE_BYTES, offset)) for offset in offsets)

    return turn


def check(name: str, path: Path, topics: list[str] | None) -> int:
    """Return the number of messages that both readers read alike; the file is in the page cache then."""
    with path.open("rb") as file, LogReader(path) as reader:
        theirs = make_reader(file).iter_messages(topics=topics)
        count = 0
        for message, (_, channel, other) in zip(reader.messages(topics), theirs, strict=True):
            times = message.log_time_ns, message.publish_time_ns
            if (message.topic, *times) != (channel.topic, other.log_time, other.publish_time):
                raise SystemExit(f"{name}: the readers differ in a header")
            if message.data != other.data:
                raise SystemExit(f"{name}: the readers differ in the bytes of a payload")
            count += 1
    return count


def compare(
    name: str, path: Path, topics: list[str] | None, rounds: int, report: Report, least: float = 5.0
) -> None:
    """Add one row: the time of the stock reader divided by that of ipsys, wanted to be ``least`` or more."""
    messages = check(name, path, topics)
    contenders = [Contender("mcap", stock, (path, topics)), Contender("ours", ours, (path, topics))]
    contenders += [Contender("pread", bare, (path, topics))] if topics is None else []
    timings = race(contenders, 1, rounds)
    report.rows.append(ratio_row(f"mcap / ours, {name}", timings["mcap"], timings["ours"], (">=", least)))
    if "pread" in timings:
        report.rows.append(ratio_row("  mcap / bare os.pread of the file", timings["mcap"], timings["pread"]))
    report.details[name] = {
        **{f"{contender}_cpu_s": timing.cpu_s for contender, timing in timings.items()},
        **{f"{contender}_wall_s": timing.wall_s for contender, timing in timings.items()},
        "messages": messages,
        "bytes": timings["ours"].kept[0],
    }


def measure(options: argparse.Namespace) -> Report:
    """Compare logs of other writers, a log of ipsys, and a log without images."""
    report = Report("log_read")
    gigabytes = 0.01 if options.smoke else options.gb
    messages = 1_000 if options.smoke else 100_000
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        path = Path(folder) / "log.mcap"
        # Both readers unpack a compressed chunk as a whole; only ours checks its CRC.
        for name, least in (("NONE", 5.0), ("ZSTD", 0.5), ("LZ4", 0.5)):
            write_foreign(path, gigabytes, CompressionType[name])
            compare(f"small of mcap's {name}", path, ["/points"], options.rounds, report, least)
            path.unlink()
        write_own(path, gigabytes)
        compare("small of our own", path, ["/points"], options.rounds, report)
        with LogReader(path) as reader:
            for _ in reader.messages(["/points"]):
                pass
            share = 100 * reader.bytes_read / reader.size
        compare("all of our own, images too", path, None, options.rounds, report)
        path.unlink()
        write_small(path, messages)
        compare("100,000 small, no images", path, None, options.rounds, report)
    report.rows.append(Row("own log read for its small", (share,), "% of bytes"))
    report.details["gb"] = gigabytes
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--gb", type=float, default=1.0, help="size of each log that is read")


if __name__ == "__main__":
    command("log_read")
