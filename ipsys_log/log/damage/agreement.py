"""Comparison of the data section, the indexes and the summary of a log, which must agree."""

from collections import Counter

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunk_messages import chunk_entries
from ipsys_log.log.contents import Contents
from ipsys_log.log.damage.findings import Survey
from ipsys_log.log.damage.resync import PRIVATE
from ipsys_log.log.records import DATA_END, ChunkRef, parse_exact, walk
from ipsys_log.log.summary import Summary, load_contents, read_summary


def disagreement(view: LogBytes, findings: Survey) -> str:
    """Return the first disagreement of a log with its survey, "" if there is none."""
    try:
        loaded, summary = load_contents(view), read_summary(view)
        if summary is not None:
            _check_lengths(view, loaded.data_end + DATA_END.size)
    except UnreadError:
        raise
    except LogError as error:
        return str(error).split(" is damaged ", 1)[-1].split(". Run:", 1)[0]
    surveyed = findings.contents
    counts = (
        f"readers count {sum(loaded.counts.values())} messages, but there are {sum(surveyed.counts.values())}"
    )
    tests = (
        (
            not findings.finished or bool(findings.damaged) or not findings.crc_is_right,
            "its data section is damaged",
        ),
        (loaded.data_end != findings.end, "its summary belongs to another data section"),
        (Counter(surveyed.counts) != Counter(loaded.counts), counts),
        (not _same_chunks(loaded.chunks, surveyed.chunks), "its chunks are not those that readers expect"),
    )
    difference = next((difference for is_wrong, difference in tests if is_wrong), "")
    return difference if difference or summary is None else _summary_disagreement(summary, surveyed, findings)


def count_by_indexes(view: LogBytes) -> int:
    """Return the number of messages that a reader finds by the summary and the message indexes."""
    contents = load_contents(view)
    total = sum(map(len, contents.unchunked.values()))
    for chunk in contents.chunks:
        total += sum(map(len, chunk_entries(view, chunk, {}).values()))
    return total


def _check_lengths(view: LogBytes, start: int) -> None:
    """Refuse a summary with wrong lengths: a reader that trusts them would read too much."""
    for record_at in walk(view, start, view.size):
        if record_at.opcode == Opcode.FOOTER:
            return
        if record_at.opcode < PRIVATE:
            parse_exact(view, record_at, view.read(record_at.offset, record_at.length))


def _summary_disagreement(summary: Summary, surveyed: Contents, findings: Survey) -> str:
    loaded, statistics, _ = summary
    if loaded.chunks and not _same_chunks(loaded.chunks, surveyed.chunks):
        return "its chunk indexes do not match its chunks"
    for kind, records, defined in (
        ("schema", loaded.schemas, findings.definitions.schemas),
        ("channel", loaded.channels, findings.definitions.channels),
    ):
        if any(defined.get(key, record) != record for key, record in records.items()):
            return f"a {kind} is defined in two ways"
        if records and not _used(kind, surveyed) <= records.keys():
            return f"a {kind} is missing in its summary"
    if loaded.attachments and _places(loaded.attachments) != _places(surveyed.attachments):
        return "its attachment indexes are wrong"
    if loaded.metadata and _places(loaded.metadata) != _places(surveyed.metadata):
        return "its metadata indexes are wrong"
    return "its statistics are wrong" if statistics and not _fits(statistics, surveyed) else ""


def _used(kind: str, surveyed: Contents) -> set[int]:
    """Return the ids of the channels that have messages, or of their schemas."""
    used = {channel for channel, number in surveyed.counts.items() if number}
    return used if kind == "channel" else {surveyed.channels[key].schema_id for key in used} - {0}


def _places(records: list[mcap.AttachmentIndex] | list[mcap.MetadataIndex]) -> list[tuple[int, int, str]]:
    return sorted((record.offset, record.length, record.name) for record in records)


def _fits(statistics: mcap.Statistics, surveyed: Contents) -> bool:
    counts = Counter(statistics.channel_message_counts) == Counter(surveyed.counts)
    total = statistics.message_count == sum(surveyed.counts.values())
    span = (statistics.message_start_time, statistics.message_end_time)
    return counts and total and (not statistics.message_count or span == (surveyed.start_ns, surveyed.end_ns))


def _same_chunks(loaded: list[ChunkRef], surveyed: list[ChunkRef]) -> bool:
    return len(loaded) == len(surveyed) and all(map(_same_chunk, loaded, surveyed))


def _same_chunk(loaded: ChunkRef, surveyed: ChunkRef) -> bool:
    """Compare all fields that readers use; a writer may leave out the message indexes."""
    lengths = (surveyed.index_length,) if loaded.index_offsets else (0, surveyed.index_length)
    offsets = loaded.index_offsets in ({}, surveyed.index_offsets) and loaded.index_length in lengths
    same = loaded._replace(index_length=0, index_offsets={}) == surveyed._replace(
        index_length=0, index_offsets={}
    )
    return same and offsets
