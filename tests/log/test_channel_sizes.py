"""The sizes of channels, compared with the mcap library."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from mcap import records as mcap
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from ipsys_log.log.reader import LogReader
from tests.conftest import ROOT
from tests.log.test_foreign import SHAPES, write

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
