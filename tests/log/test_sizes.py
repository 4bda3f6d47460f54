"""Messages of every size up to a whole chunk: long ones use other code paths."""

import random
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap import records as mcap
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from tests.conftest import ROOT
from tests.log.conftest import Row, append, as_row, create, linear_rows, stock_rows
from tests.log.test_crash import check_recording, record_recording
from tests.log.test_foreign import SHAPES, write
from tests.log.test_properties import hash_of

EDGES = [0, 1, 16 << 10, 32 << 10, 256 << 10, 300_000, 1 << 20]
SIZES = st.one_of(
    st.integers(0, 300),
    st.builds(lambda edge, more: max(0, edge + more), st.sampled_from(EDGES), st.integers(-40, 40)),
)


@st.composite
def any_rows(draw: st.DrawFn) -> list[Row]:
    """Draw topics and log times in any order, and payloads that compress or not."""
    chance = random.Random(draw(st.integers(0, 9)))
    rows: list[Row] = []
    for _ in range(draw(st.integers(0, 12))):
        topic = draw(st.sampled_from(["/image/a", "/image/b", "/points", "/scan"]))
        size, noise = draw(SIZES), draw(st.booleans())
        data = chance.randbytes(size) if noise else b"x" * size
        rows.append((topic, draw(st.integers(0, 5 * 10**8)), draw(st.integers(0, 99)), data))
    return rows


@settings(max_examples=60)
@given(any_rows(), any_rows())
def test_own_logs(first: list[Row], second: list[Row]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = append(create(Path(folder) / "log.mcap", first), second)
        everything = sorted(first + second)
        assert sorted(stock_rows(path)) == everything
        assert sorted(linear_rows(path)) == everything  # the CRC of the data section is correct
        check(path, first + second)
        assert not repair(path).changed


@settings(max_examples=60)
@given(any_rows(), st.sampled_from(list(CompressionType)), st.sampled_from([100, 300_000, 4 << 20]))
def test_foreign_logs(rows: list[Row], compression: CompressionType, chunk_size: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=chunk_size, compression=compression)
            writer.start()
            ids = {topic: writer.register_channel(topic, "x", 0) for topic, *_ in rows}
            for topic, log_time, publish_time, data in rows:
                writer.add_message(ids[topic], log_time, data, publish_time)
            writer.finish()  # type: ignore[no-untyped-call]
        check(path, rows)


def check(path: Path, rows: list[Row]) -> None:
    """Read all topics, and each topic alone, with messages of other topics between its own."""
    with LogReader(path) as reader:
        got = [as_row(message) for message in reader.messages()]
        assert sorted(got) == sorted(rows)
        assert [row[1] for row in got] == sorted(row[1] for row in rows)
        for topic in {row[0] for row in rows}:
            mine = sorted((row for row in rows if row[0] == topic), key=lambda row: row[1])
            assert [as_row(message) for message in reader.messages([topic])] == mine
            assert reader.channel_hash(topic) == hash_of(mine)


@given(st.lists(st.integers(0, 5 * 10**9), max_size=20))
def test_no_chunk_spans_a_second(times: list[int]) -> None:
    """This is true for times in any order, so a reader opens few chunks at once."""
    with tempfile.TemporaryDirectory() as folder:
        path = create(Path(folder) / "log.mcap", [("/points", time, time, b"point") for time in times])
        with LogReader(path) as reader:
            chunks = reader._contents.chunks
            assert sum(len(reader.times(topic)) for topic in reader.channels) == len(times)
        assert all(chunk.end_ns - chunk.start_ns < 10**9 for chunk in chunks)


@pytest.mark.slow
def test_a_recording_of_frames_cut_at_every_point(tmp_path: Path) -> None:
    """The test is that of test_crash, with frames so large that CRCs are combined."""
    chance = random.Random(8)
    rows: list[Row] = []
    for k in range(5):
        rows.append(("/image/a", k * 6 * 10**8, k, chance.randbytes(40_000)))
        rows.append(("/points", k * 6 * 10**8 + 1, k, chance.randbytes(50)))
    operations = record_recording(tmp_path / "recording.mcap", rows)
    kept = check_recording(tmp_path / "crashed", rows, operations, tries=4)
    assert {0, len(rows)} <= kept


LOGS = [*(ROOT / "sample_logs").glob("*.mcap"), *(ROOT / "tests/golden").glob("*.mcap")]


def check_sizes(path: Path) -> None:
    """Compare messages and payload by topic with the stock reader, and the rest with the file."""
    messages: Counter[str] = Counter()
    payload: Counter[str] = Counter()
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        for record in StreamReader(file).records:
            if isinstance(record, mcap.Channel):
                topics[record.id] = record.topic
            elif isinstance(record, mcap.Message):
                topic = topics[record.channel_id]
                messages[topic] += 1
                payload[topic] += len(record.data)
    with LogReader(path) as reader:
        sizes = reader.sizes()
    assert Counter({size.topic: size.messages for size in sizes}) == messages
    assert Counter({size.topic: size.payload_bytes for size in sizes}) == payload
    stored = [size.stored_bytes for size in sizes]
    assert stored == sorted(stored, reverse=True)
    assert 0 < sum(stored) < path.stat().st_size


@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_sizes_are_those_of_the_stock_reader(path: Path) -> None:
    check_sizes(path)


@pytest.mark.parametrize("shape", SHAPES)
def test_sizes_of_foreign_logs_are_those_of_the_stock_reader(shape: str, tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    write(path, **SHAPES[shape])
    check_sizes(path)


def test_compressed_chunks_are_smaller_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    write(path, **SHAPES["plain"])
    with LogReader(path) as reader:
        plain = {size.topic: size for size in reader.sizes()}
    write(path, **SHAPES["zstd"])
    with LogReader(path) as reader:
        packed = {size.topic: size for size in reader.sizes()}
    for topic, size in plain.items():
        # 31 bytes are the head of a message.
        assert size.stored_bytes == size.payload_bytes + 31 * size.messages
        assert packed[topic].payload_bytes == size.payload_bytes
        assert packed[topic].stored_bytes < size.stored_bytes / 2


def test_stored_bytes_of_a_chunk_are_those_in_the_summary(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    write(path, **SHAPES["lz4"])
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        packed = sum(chunk.compressed_size for chunk in summary.chunk_indexes)
    with LogReader(path) as reader:
        stored = sum(size.stored_bytes for size in reader.sizes())
    assert 0.8 * packed < stored <= packed  # the rest are definitions
