"""Findings of a survey: whole and damaged parts of a log, and its lost messages."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from mcap.opcode import Opcode

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunks import ChunkContents
from ipsys_log.log.contents import Contents
from ipsys_log.log.damage.definitions import Definitions
from ipsys_log.log.damage.regions import DamagedRange
from ipsys_log.log.damage.resync import Resync
from ipsys_log.log.damage.salvage import Rows, Salvage, Saved
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import HEADER, RecordAt


@dataclass(slots=True)
class Lost:
    """The lost messages: their log times in ns, by topic.

    `uncounted` is the number of ranges with an unknown number of messages, `bytes` the number of
    unreadable bytes.
    """

    times_ns: dict[str, list[int]] = field(default_factory=dict)
    uncounted: int = 0
    bytes: int = 0

    def add(self, topic: str, time_ns: int) -> None:
        self.times_ns.setdefault(topic, []).append(time_ns)


@dataclass(slots=True)
class IndexGroup:
    """The message indexes after a chunk (`inside`), or after a damaged range that may have been a chunk."""

    start: int
    inside: ChunkContents | None = None
    damaged_range: DamagedRange | None = None
    rows: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    offsets: dict[int, int] = field(default_factory=dict)
    sound: bool = True

    @property
    def is_complete(self) -> bool:
        return self.inside is not None and self.sound and self.rows.keys() >= self.inside.entries.keys()


@dataclass(frozen=True, slots=True)
class Watch:
    """Functions that a survey calls while it reads a log.

    `progress` gets the number of bytes that are checked. `message` gets the topic, the log time and the
    publish time in ns of each whole message, in the order of the file.
    """

    progress: Callable[[int], None] = lambda checked: None
    message: Callable[[str, int, int], None] = lambda topic, log_time_ns, publish_time_ns: None


@dataclass(slots=True)
class Survey:
    """The whole records up to `end`, except the ranges in `damaged`.

    `cut` is the unreadable end of a log without DataEnd; `finished` says that DataEnd lies at `end`.
    `salvage` collects the readable messages of damaged chunks. `faults` lists the faults in words.
    `unindexed` holds the entries of the last chunk if its message indexes are missing or cut off.
    """

    view: LogBytes
    resync: Resync
    definitions: Definitions
    salvage: Salvage | None = None
    watch: Watch = field(default_factory=Watch)
    contents: Contents = field(default_factory=Contents)
    unchunked: ChunkContents = field(default_factory=ChunkContents)
    counts: dict[int, dict[int, int]] = field(default_factory=dict)
    hashes: dict[str, ChannelHash] = field(default_factory=dict)
    damaged: list[DamagedRange] = field(default_factory=list)
    displaced: list[RecordAt] = field(default_factory=list)  # messages that cannot stay at their offset
    wrong_heads: list[tuple[int, bytes]] = field(default_factory=list)  # offset, right time range
    cut: DamagedRange | None = None
    lost: Lost = field(default_factory=Lost)
    faults: list[str] = field(default_factory=list)
    unindexed: ChunkContents | None = None
    end: int = 0
    crc: int = 0
    crc_is_right: bool = True
    has_crc: bool = False  # the data section has a CRC
    finished: bool = False
    crc_at: int = 0
    wrong_length: int = -1  # a record with an impossible length
    has_crcs: bool = False  # a chunk so far has a CRC
    doubtful_to: int = 0  # offset: before it, unconfirmed lengths are checked closely
    indexed: IndexGroup | None = None


UNCHUNKED = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.ATTACHMENT, Opcode.METADATA))
# If such a record is damaged, the number of lost messages is known: zero or one.
COUNTED = UNCHUNKED | {Opcode.MESSAGE_INDEX, Opcode.DATA_END}
_DOUBTFUL = 4096  # bytes


def skip_damage(findings: Survey, position: int, record: RecordAt | None, reason: str) -> int:
    """Find the next record after damage at `position`; return its offset."""
    claimed = record.offset + record.length if record is not None and findings.wrong_length != position else 0
    indexed = findings.indexed
    # A gap that is too small for a separate record becomes a part of the damage before it.
    behind_indexes = indexed is not None and indexed.inside is not None and position > indexed.start
    joins = behind_indexes or bool(findings.damaged and findings.damaged[-1].end == position)
    follower = findings.resync.find(position, claimed, gap=1 if joins else HEADER.size)
    is_small = follower is not None and follower < position + HEADER.size
    if indexed is not None and indexed.inside is not None:
        is_apart = indexed.is_complete or findings.resync.is_chunk_head(position)
        if is_apart and not is_small:
            close_indexes(findings, position)
        else:
            findings.faults.append(reason)
            indexed.sound = False
            findings.end = findings.view.size if follower is None else follower
            return findings.end
    elif indexed is not None:
        close_indexes(findings, position)
    if follower is None:
        return _end_at_damage(findings, position, reason)
    if record is None or record.opcode not in COUNTED or follower != claimed:
        findings.indexed = IndexGroup(follower)
    return add_damage(findings, DamagedRange(position, follower - position), reason)


def add_damage(findings: Survey, damaged_range: DamagedRange, reason: str) -> int:
    """Note a damaged range; return its end."""
    findings.faults.append(reason)
    findings.lost.bytes += damaged_range.length
    if findings.indexed is not None:
        findings.indexed.damaged_range = replace(damaged_range)
    last = findings.damaged[-1] if findings.damaged else None
    if last is not None and last.end == damaged_range.offset:  # join both, so that definitions have more room
        last.length += damaged_range.length
    else:
        findings.damaged.append(damaged_range)
    findings.end = damaged_range.end
    findings.doubtful_to = max(findings.doubtful_to, damaged_range.end + _DOUBTFUL)
    return damaged_range.end


def _end_at_damage(findings: Survey, position: int, reason: str) -> int:
    """End the survey at damage without later records, perhaps in an unfinished chunk."""
    findings.faults.append(reason)
    findings.end = position
    findings.cut = DamagedRange(position, findings.view.size - position)
    findings.lost.bytes += findings.cut.length
    _save(findings, findings.cut, {})
    return findings.view.size


def _save(findings: Survey, damaged_range: DamagedRange, rows: Rows) -> None:
    """Save the readable messages of a damaged chunk, and note the others as lost."""
    saved = Saved()
    if findings.salvage is not None and findings.resync.chunked is not False:
        saved = findings.salvage.save(
            findings.view,
            damaged_range,
            rows,
            findings.definitions,
            findings.hashes,
            in_order=damaged_range is findings.cut,
        )
    lost_messages = [
        (channel, time_ns)
        for channel, entries in rows.items()
        for time_ns, offset in entries
        if (channel, offset) not in saved.messages
    ]
    for channel, time_ns in lost_messages if rows else saved.torn:
        findings.lost.add(findings.definitions.topic(channel), time_ns)
    if saved.note:
        findings.faults.append(saved.note)
    findings.lost.uncounted += not (rows or saved.counted)
    findings.lost.bytes -= int(saved.share * damaged_range.length)


def close_indexes(findings: Survey, stop: int) -> None:
    """Check the message indexes of a chunk, or of a damaged range, after all of them are read."""
    indexed, findings.indexed = findings.indexed, None
    assert indexed is not None
    if indexed.damaged_range is not None:
        _save(findings, indexed.damaged_range, indexed.rows)
    elif indexed.inside is not None:
        _close_chunk(findings, indexed, indexed.inside, stop)


def _close_chunk(findings: Survey, indexed: IndexGroup, inside: ChunkContents, stop: int) -> None:
    chunk = findings.contents.chunks[-1]
    if indexed.is_complete:
        findings.contents.chunks[-1] = chunk._replace(
            index_length=stop - indexed.start, index_offsets=indexed.offsets
        )
        return
    if stop == findings.view.size:  # the log has no end: the repair writes it with these indexes
        findings.end = indexed.start
        findings.cut = DamagedRange(findings.end, stop - findings.end)
        findings.unindexed = inside
    elif stop > indexed.start:
        number = len(findings.contents.chunks) - 1
        damaged_range = DamagedRange(
            indexed.start, stop - indexed.start, chunk=number, entries=inside.entries
        )
        findings.damaged.append(damaged_range)
        if indexed.sound:
            findings.faults.append("the message indexes of a chunk are not complete")
