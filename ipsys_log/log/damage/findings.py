"""Findings of a survey: whole and damaged parts of a log, and its lost messages."""

from dataclasses import dataclass, field, replace

from mcap.opcode import Opcode

from ipsys_log.log.byte_source import View
from ipsys_log.log.chunks import Inside
from ipsys_log.log.contents import Contents
from ipsys_log.log.damage.definitions import Definitions
from ipsys_log.log.damage.regions import Stretch
from ipsys_log.log.damage.resync import Resync
from ipsys_log.log.damage.salvage import Rows, Salvage, Saved
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import HEADER, RecordAt

__all__ = ["COUNTED", "LOOSE", "Indexed", "Lost", "Survey", "add_damage", "close_indexes", "pass_over"]


@dataclass(slots=True)
class Lost:
    """The lost messages: their log times in ns, by topic.

    `uncounted` is the number of stretches with an unknown number of messages, `bytes` the number of
    unreadable bytes.
    """

    times_ns: dict[str, list[int]] = field(default_factory=dict)
    uncounted: int = 0
    bytes: int = 0

    def note(self, topic: str, time_ns: int) -> None:
        self.times_ns.setdefault(topic, []).append(time_ns)


@dataclass(slots=True)
class Indexed:
    """The message indexes after a chunk (`inside`), or after a damaged stretch that may have been a chunk."""

    start: int
    inside: Inside | None = None
    stretch: Stretch | None = None
    rows: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    offsets: dict[int, int] = field(default_factory=dict)
    sound: bool = True

    @property
    def is_complete(self) -> bool:
        return self.inside is not None and self.sound and self.rows.keys() >= self.inside.entries.keys()


@dataclass(slots=True)
class Survey:
    """The whole records up to `end`, except the stretches in `damaged`.

    `cut` is the unreadable end of a log without DataEnd; `finished` says that DataEnd lies at `end`.
    `saved` collects the readable messages of damaged chunks. `faults` lists the faults in words.
    `unindexed` holds the entries of the last chunk if its message indexes are missing or cut off.
    """

    view: View
    resync: Resync
    definitions: Definitions
    saved: Salvage | None = None
    contents: Contents = field(default_factory=Contents)
    loose: Inside = field(default_factory=Inside)
    counts: dict[int, dict[int, int]] = field(default_factory=dict)
    hashes: dict[str, ChannelHash] = field(default_factory=dict)
    damaged: list[Stretch] = field(default_factory=list)
    homeless: list[RecordAt] = field(default_factory=list)  # messages that cannot stay at their offset
    wrong_heads: list[tuple[int, bytes]] = field(default_factory=list)  # offset, right time range
    cut: Stretch | None = None
    lost: Lost = field(default_factory=Lost)
    faults: list[str] = field(default_factory=list)
    unindexed: Inside | None = None
    end: int = 0
    crc: int = 0
    crc_is_right: bool = True
    has_crc: bool = False  # the data section has a CRC
    finished: bool = False
    crc_at: int = 0
    wrong_length: int = -1  # a record with an impossible length
    has_crcs: bool = False  # a chunk so far has a CRC
    doubtful_to: int = 0  # offset: before it, unconfirmed lengths are checked closely
    indexed: Indexed | None = None


LOOSE = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.ATTACHMENT, Opcode.METADATA))
# If such a record is damaged, the number of lost messages is known: zero or one.
COUNTED = LOOSE | {Opcode.MESSAGE_INDEX, Opcode.DATA_END}
_DOUBTFUL = 4096  # bytes


def pass_over(found: Survey, position: int, at: RecordAt | None, reason: str) -> int:
    """Find the next record after damage at `position`; return its offset."""
    claimed = at.offset + at.length if at is not None and found.wrong_length != position else 0
    indexed = found.indexed
    # A gap that is too small for a separate record becomes a part of the damage before it.
    behind_indexes = indexed is not None and indexed.inside is not None and position > indexed.start
    joins = behind_indexes or bool(found.damaged and found.damaged[-1].end == position)
    follower = found.resync.find(position, claimed, gap=1 if joins else HEADER.size)
    is_small = follower is not None and follower < position + HEADER.size
    if indexed is not None and indexed.inside is not None:
        is_apart = indexed.is_complete or found.resync.is_chunk_head(position)
        if is_apart and not is_small:
            close_indexes(found, position)
        else:
            found.faults.append(reason)
            indexed.sound = False
            found.end = found.view.size if follower is None else follower
            return found.end
    elif indexed is not None:
        close_indexes(found, position)
    if follower is None:
        return _end_at_damage(found, position, reason)
    if at is None or at.opcode not in COUNTED or follower != claimed:
        found.indexed = Indexed(follower)
    return add_damage(found, Stretch(position, follower - position), reason)


def add_damage(found: Survey, stretch: Stretch, reason: str) -> int:
    """Note a damaged stretch; return its end."""
    found.faults.append(reason)
    found.lost.bytes += stretch.length
    if found.indexed is not None:
        found.indexed.stretch = replace(stretch)
    last = found.damaged[-1] if found.damaged else None
    if last is not None and last.end == stretch.offset:  # join both, so that definitions have more room
        last.length += stretch.length
    else:
        found.damaged.append(stretch)
    found.end = stretch.end
    found.doubtful_to = max(found.doubtful_to, stretch.end + _DOUBTFUL)
    return stretch.end


def _end_at_damage(found: Survey, position: int, reason: str) -> int:
    """End the survey at damage without later records, perhaps in an unfinished chunk."""
    found.faults.append(reason)
    found.end = position
    found.cut = Stretch(position, found.view.size - position)
    found.lost.bytes += found.cut.length
    _save(found, found.cut, {})
    return found.view.size


def _save(found: Survey, stretch: Stretch, rows: Rows) -> None:
    """Save the readable messages of a damaged chunk, and note the others as lost."""
    saved = Saved()
    if found.saved is not None and found.resync.chunked is not False:
        saved = found.saved.save(
            found.view, stretch, rows, found.definitions, found.hashes, in_order=stretch is found.cut
        )
    lost_messages = [
        (channel, time_ns)
        for channel, entries in rows.items()
        for time_ns, offset in entries
        if (channel, offset) not in saved.messages
    ]
    for channel, time_ns in lost_messages if rows else saved.torn:
        found.lost.note(found.definitions.topic(channel), time_ns)
    if saved.note:
        found.faults.append(saved.note)
    found.lost.uncounted += not (rows or saved.counted)
    found.lost.bytes -= int(saved.share * stretch.length)


def close_indexes(found: Survey, stop: int) -> None:
    """Check the message indexes of a chunk, or of a damaged stretch, after all of them are read."""
    indexed, found.indexed = found.indexed, None
    assert indexed is not None
    if indexed.stretch is not None:
        _save(found, indexed.stretch, indexed.rows)
    elif indexed.inside is not None:
        _close_chunk(found, indexed, indexed.inside, stop)


def _close_chunk(found: Survey, indexed: Indexed, inside: Inside, stop: int) -> None:
    chunk = found.contents.chunks[-1]
    if indexed.is_complete:
        found.contents.chunks[-1] = chunk._replace(
            index_length=stop - indexed.start, index_offsets=indexed.offsets
        )
        return
    if stop == found.view.size:  # the log has no end: the repair writes it with these indexes
        found.end = indexed.start
        found.cut = Stretch(found.end, stop - found.end)
        found.unindexed = inside
    elif stop > indexed.start:
        number = len(found.contents.chunks) - 1
        stretch = Stretch(indexed.start, stop - indexed.start, chunk=number, entries=inside.entries)
        found.damaged.append(stretch)
        if indexed.sound:
            found.faults.append("the message indexes of a chunk are not complete")
