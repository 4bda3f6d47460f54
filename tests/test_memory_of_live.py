"""Memory that a live run keeps, for days: nothing may grow with its frames."""

import tracemalloc
from pathlib import Path

from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter
from ipsys_log.stages.detect.prints import build_prints

CHUNKS, TOPICS = 400, 20


def test_open_log_keeps_few_bytes_per_chunk(tmp_path: Path) -> None:
    """Until its end, a log keeps 10 bytes for each channel in a chunk, and 160 bytes for the chunk."""
    kept: list[int] = []
    with LogWriter.create(tmp_path / "a.mcap") as writer:
        for topic in range(TOPICS):
            writer.add_channel(f"/{topic}", None, "json")
        for number in range(2 * CHUNKS):
            if number == CHUNKS:
                tracemalloc.start()
                kept.append(tracemalloc.get_traced_memory()[0])
            for topic in range(TOPICS):
                writer.write(f"/{topic}", (number + 1) << 40, 1, b"{}")
            writer.flush()
        kept.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert kept[1] - kept[0] < CHUNKS * (160 + 10 * TOPICS)
    with LogReader(tmp_path / "a.mcap") as reader:
        assert reader.chunk_count == 2 * CHUNKS
        assert sum(1 for _ in reader.messages(["/7"])) == 2 * CHUNKS


def test_prints_of_many_sets_of_markers_are_forgotten() -> None:
    build_prints("DICT_4X4_100", tuple(range(60)))  # the edges of each marker stay
    tracemalloc.start()
    for number in range(300):
        build_prints("DICT_4X4_100", (*(n for n in range(40) if number >> (n % 9) & 1), 50 + number % 10))
    size = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert size < 32 * 300_000
