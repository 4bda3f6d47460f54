"""Check of the file of a log: every record, CRC and index, without any change of the file."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.byte_source import LogBytes, reason_of
from ipsys_log.log.contents import Contents
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.record_search import PRIVATE
from ipsys_log.log.records import DATA_END, ChunkRef, parse_exact, walk
from ipsys_log.log.summary import Summary, load_contents, read_intact_summary, read_summary
from ipsys_log.log.survey import Kind, Survey, Watch


@dataclass(frozen=True, slots=True)
class FileCheck:
    """The result of the check of a file.

    ``faults`` are the faults in words, in the order of the file. ``interrupted`` says that an append was
    interrupted, so that readers use the log before it. ``changed_topics`` have other messages than the stored
    hash of their writer says.
    """

    faults: tuple[str, ...] = ()
    interrupted: bool = False
    changed_topics: tuple[str, ...] = ()


def check_file(
    view: LogBytes, contents: Contents, stored: Mapping[str, ChannelHash], watch: Watch
) -> FileCheck:
    """Read a log completely, and compare its data section, its indexes and its summary.

    Parameters
    ----------
    contents : the table of contents that readers use.
    stored : the hashes that writers stored in the log, by topic.
    watch : follows the reading.
    """
    survey = Survey(view, read_intact_summary(view), watch)
    faults = _faults_before(contents.data_end, survey) if contents.cut_short else _faults(view, survey)
    changed = [
        topic
        for topic, state in sorted(survey.hashes.items())
        if topic in stored and state.valid and _differs(state, stored[topic])
    ]
    return FileCheck(faults, contents.cut_short or view.is_interrupted, tuple(changed))


def _faults(view: LogBytes, survey: Survey) -> tuple[str, ...]:
    difference = disagreement(view, survey)
    if not difference:
        return ()
    return tuple(text for _, text in survey.faults) or (difference,)


def _faults_before(data_end: int, survey: Survey) -> tuple[str, ...]:
    """Return the damage before `data_end`: after it, there are parts of an interrupted append."""
    return tuple(
        f"bytes {part.start} to {min(part.end, data_end)} cannot be read"
        for part in survey.parts
        if part.kind == Kind.DAMAGE and part.start < data_end
    )


def _differs(state: ChannelHash, stored: ChannelHash) -> bool:
    return state.count == stored.count and state.digest != stored.digest


def disagreement(view: LogBytes, survey: Survey) -> str:
    """Return the first disagreement of the data section, the indexes and the summary, "" if there is none."""
    try:
        loaded, summary = load_contents(view), read_summary(view)
        if summary is not None:
            _check_lengths(view, loaded.data_end + DATA_END.size)
    except UnreadError:
        raise
    except LogError as error:
        return reason_of(error)
    surveyed = survey.contents
    counts = (
        f"readers count {sum(loaded.counts.values())} messages, but there are {sum(surveyed.counts.values())}"
    )
    tests = (
        (not survey.finished or bool(survey.faults), "its data section is damaged"),
        (loaded.data_end != survey.data_end, "its summary belongs to another data section"),
        (Counter(surveyed.counts) != Counter(loaded.counts), counts),
        (not _same_chunks(loaded.chunks, surveyed.chunks), "its chunks are not those that readers expect"),
    )
    difference = next((difference for is_wrong, difference in tests if is_wrong), "")
    return difference if difference or summary is None else _summary_disagreement(summary, survey)


def _check_lengths(view: LogBytes, start: int) -> None:
    """Refuse a summary with wrong lengths: a reader that trusts them would read too much."""
    for record in walk(view, start, view.size):
        if record.opcode == Opcode.FOOTER:
            return
        if record.opcode < PRIVATE:
            parse_exact(view, record, view.read(record.offset, record.length))


def _summary_disagreement(summary: Summary, survey: Survey) -> str:
    loaded, statistics, _ = summary
    surveyed = survey.contents
    if loaded.chunks and not _same_chunks(loaded.chunks, surveyed.chunks):
        return "its chunk indexes do not match its chunks"
    used = {channel for channel, number in surveyed.counts.items() if number}
    used_schemas = {surveyed.channels[key].schema_id for key in used} - {0}
    if (loaded.channels and not used <= loaded.channels.keys()) or (
        loaded.schemas and not used_schemas <= loaded.schemas.keys()
    ):
        return "a definition is missing in its summary"
    if loaded.attachments and _places(loaded.attachments) != _places(surveyed.attachments):
        return "its attachment indexes are wrong"
    if loaded.metadata and _places(loaded.metadata) != _places(surveyed.metadata):
        return "its metadata indexes are wrong"
    return "its statistics are wrong" if statistics and not _fits(statistics, surveyed) else ""


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
