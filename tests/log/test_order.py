"""The merge of chunks that overlap in time, without files."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.log.chunk_messages import Cursor, PendingChunk, in_log_order
from ipsys_log.log.contents import RawMessage

Chunk = tuple[int, list[int]]  # time from the claimed start to the first message, and log times
CHUNKS = st.lists(st.tuples(st.integers(0, 3), st.lists(st.integers(3, 30), max_size=8)), max_size=8)


class Opened:
    """Return chunks at offsets 100, 200, ..., of messages with their own offset as publish time."""

    def __init__(self, chunks: list[Chunk]) -> None:
        self.places: list[int] = []
        self.pending = [self._pending(100 * n, *chunk) for n, chunk in enumerate(chunks, 1)]

    def _pending(self, place: int, early_ns: int, times: list[int]) -> PendingChunk:
        rows = sorted((time, offset) for offset, time in enumerate(times))

        def between(first: int, stop: int) -> Iterator[RawMessage]:
            return (RawMessage(str(place), time, offset, b"") for time, offset in rows[first:stop])

        def open_() -> Cursor:
            self.places.append(place)
            return Cursor(place, [time for time, _ in rows], [offset for _, offset in rows], between)

        return PendingChunk(min(times, default=5) - early_ns, place, open_)


def fault(place: int) -> Exception:
    return ValueError(place)


@given(CHUNKS)
def test_by_time_then_chunk_then_offset(chunks: list[Chunk]) -> None:
    opened = Opened(chunks)
    got = [(m.log_time_ns, int(m.topic), m.publish_time_ns) for m in in_log_order(opened.pending, fault)]
    rows = [(n, row) for n, (_, times) in enumerate(chunks, 1) for row in enumerate(times)]
    assert got == sorted((time, 100 * n, offset) for n, (offset, time) in rows)
    assert sorted(opened.places) == [chunk.offset for chunk in opened.pending]


@given(CHUNKS)
def test_chunks_are_opened_as_late_as_possible(chunks: list[Chunk]) -> None:
    opened = Opened(chunks)
    last_ns = 0
    for message in in_log_order(opened.pending, fault):
        last_ns = message.log_time_ns
        due = {chunk.offset for chunk in opened.pending if chunk.start_ns <= last_ns}
        assert due == set(opened.places)


@pytest.mark.parametrize("others", [[5, 20], [5, 6, 7, 8, 20]])
def test_a_message_from_before_its_chunk_says(others: list[int]) -> None:
    """The second chunk claims to start at 9 but contains a message of 4."""
    pending = Opened([(0, others), (-5, [4])]).pending
    with pytest.raises(ValueError, match="200"):
        list(in_log_order(pending, fault))
