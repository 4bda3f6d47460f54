"""For any messages in any order, the reader sorts them, and k sessions equal one."""

import tempfile
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from tests.log.conftest import Row, append, as_row, create, linear_rows, stock_rows

ROWS = st.lists(
    st.tuples(
        st.sampled_from(["/image/a", "/image/b", "/points", "/runs/poly/tracks"]),
        st.one_of(st.integers(0, 5), st.integers(0, 200 * 10**9), st.integers(0, (1 << 63) - 1)),
        st.integers(0, (1 << 64) - 1),
        st.binary(max_size=60),
    ),
    max_size=40,
)


@settings(max_examples=150)
@given(st.lists(ROWS, min_size=1, max_size=4), st.integers(0, 10**10), st.integers(0, 10**11))
def test_appended_sessions_equal_one_log(sessions: list[list[Row]], start: int, length: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = create(Path(folder) / "log.mcap", sessions[0])
        for rows in sessions[1:]:
            with LogReader(path) as reader:
                end = reader.data_end
            before = path.read_bytes()[:end]
            append(path, rows)
            assert path.read_bytes()[:end] == before
        everything = [row for rows in sessions for row in rows]
        with LogReader(path) as reader:
            got = [as_row(message) for message in reader.messages()]
            assert sorted(got) == sorted(everything)
            assert [row[1] for row in got] == sorted(row[1] for row in everything)
            for topic in reader.channels:
                mine = sorted((row for row in everything if row[0] == topic), key=lambda row: row[1])
                assert [as_row(message) for message in reader.messages([topic])] == mine
                part = [row for row in mine if start <= row[1] < start + length]
                assert [as_row(m) for m in reader.messages([topic], start, start + length)] == part
                assert reader.times(topic).tolist() == [row[1] for row in mine]
                assert reader.channel_hash(topic) == hash_of(mine)
        assert sorted(stock_rows(path)) == sorted(everything)
        assert sorted(linear_rows(path)) == sorted(everything)
        assert not repair(path).changed


def hash_of(rows: list[Row]) -> str:
    state = ChannelHash()
    for _, log_time, publish_time, data in rows:
        state.add(log_time, publish_time, data)
    return state.digest.hex()


@settings(max_examples=60)
@given(ROWS, st.data())
def test_repair_of_any_beginning(rows: list[Row], data: st.DataObject) -> None:
    """A log that is cut at any byte is repaired to the first messages of each channel."""
    with tempfile.TemporaryDirectory() as folder:
        path = create(Path(folder) / "log.mcap", rows)
        size = path.stat().st_size
        with path.open("r+b") as file:
            file.truncate(data.draw(st.integers(32, size)))
        repair(path)
        with LogReader(path) as reader:
            for topic in reader.channels:
                written = [row for row in rows if row[0] == topic]
                got = [as_row(message) for message in reader.messages([topic])]
                assert got == sorted(written[: len(got)], key=lambda row: row[1])
        assert not repair(path).changed
