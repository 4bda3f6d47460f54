"""First and last times of a topic: those of all its times, with few indexes read."""

from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter

MESSAGE = st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 9))


@settings(max_examples=30)
@given(st.lists(st.lists(MESSAGE, max_size=4), max_size=6))
def test_first_and_last_time_are_those_of_all_times(chunks: list[list[tuple[str, int]]]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with LogWriter.create(path) as writer:
            for topic in ("/a", "/b"):
                writer.add_channel(topic, Schema("A", "jsonschema", b"{}"), "json")
            for chunk in chunks:
                for topic, time_ns in chunk:
                    writer.write(topic, time_ns, time_ns, b"{}")
                writer.flush()
        with LogReader(path) as reader:
            for topic in ("/a", "/b"):
                times = reader.times(topic).tolist()
                assert reader.first_time(topic) == min(times, default=None)
                assert reader.last_time(topic) == max(times, default=None)
