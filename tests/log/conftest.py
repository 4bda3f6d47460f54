"""Small logs, and independent readers for comparison."""

import subprocess
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap import records as mcap
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from ipsys_log.log import remote_object
from ipsys_log.log.contents import RawMessage, Schema
from ipsys_log.log.journal import DISK, Storage
from ipsys_log.log.writer import LogWriter
from tests.log.range_server import Store, serve_ranges
from tests.node_packages import install

IMAGE = Schema("foxglove.CompressedImage", "protobuf", b"image definition")
POINT = Schema("ipsys.v1.Position", "protobuf", b"point definition")

Row = tuple[str, int, int, bytes]


def write_rows(writer: LogWriter, rows: list[Row]) -> None:
    """Declare each topic and write the rows; topics that begin with /image are images."""
    for topic, log_time, publish_time, data in rows:
        writer.add_channel(topic, IMAGE if topic.startswith("/image") else POINT)
        writer.write(topic, log_time, publish_time, data)


def create(path: Path, rows: list[Row], storage: Storage = DISK) -> Path:
    with LogWriter.create(path, storage=storage) as writer:
        write_rows(writer, rows)
    return path


def append(path: Path, rows: list[Row], storage: Storage = DISK) -> Path:
    with LogWriter.append(path, storage=storage) as writer:
        write_rows(writer, rows)
    return path


def as_row(message: RawMessage) -> Row:
    return (message.topic, message.log_time_ns, message.publish_time_ns, message.data)


def stock_rows(path: Path) -> list[Row]:
    """Read the log with the seeking reader of the mcap library, which checks chunk CRCs."""
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]


def linear_rows(path: Path) -> list[Row]:
    """Read the log with the linear reader, which also checks the CRC of the data section."""
    topics: dict[int, str] = {}
    rows: list[Row] = []
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, mcap.Channel):
                topics[record.id] = record.topic
            elif isinstance(record, mcap.Message):
                rows.append((topics[record.channel_id], record.log_time, record.publish_time, record.data))
    return rows


@pytest.fixture
def rows() -> list[Row]:
    """Write two seconds of two cameras and a small channel; some payloads need several chunks."""
    out: list[Row] = []
    for number in range(60):
        time = 1_700_000_000_000_000_000 + number * 33_000_000
        out.append((f"/image/{number % 2}", time, time - 5, bytes([number]) * (3000 + number)))
        out.append(("/points", time + 1, time - 5, f"point {number}".encode()))
    return out


@pytest.fixture
def log(tmp_path: Path, rows: list[Row]) -> Path:
    return create(tmp_path / "session.mcap", rows)


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    """Serve objects with ranges on loopback; a reader does not pause before it tries again."""
    monkeypatch.setattr(remote_object, "_PAUSES_S", (0.0,) * 4)
    with serve_ranges() as store:
        yield store


@pytest.fixture(scope="session")
def read_with_node() -> Callable[[Path], tuple[int, int, int]]:
    """Return a function that reads a log with @mcap/core: count and CRC-32 indexed, count streaming."""
    home = install("node", "@mcap/core", "@mcap/support")

    def read(path: Path) -> tuple[int, int, int]:
        script = [str(Path(__file__).with_name("read_all.mjs")), str(home), str(path)]
        done = subprocess.run(["node", *script], capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 0, done.stderr
        count, crc, streamed = (int(word) for word in done.stdout.split())
        return count, crc, streamed

    return read


def crc_of(rows: list[Row]) -> int:
    crc = 0
    for row in rows:
        crc = zlib.crc32(row[3], crc)
    return crc
