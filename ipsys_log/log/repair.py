"""Repair of a log whose writer was killed, whose end was cut off, or which is damaged inside."""

import os
import tempfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, NamedTuple, overload

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, disk_advice
from ipsys_log.log.byte_source import FileBytes
from ipsys_log.log.damage.agreement import count_by_indexes, disagreement
from ipsys_log.log.damage.findings import Survey
from ipsys_log.log.damage.kept_bytes import (
    Change,
    Patch,
    check_room,
    discard,
    keep_old_bytes,
    overwrite,
    resume,
)
from ipsys_log.log.damage.regions import index_records
from ipsys_log.log.damage.salvage import Salvage
from ipsys_log.log.damage.survey import HEADER_RECORD, survey
from ipsys_log.log.hashing import METADATA_NAME, combine, metadata_of_hashes
from ipsys_log.log.journal import DISK, Storage, replace_tail, roll_back
from ipsys_log.log.lock import open_locked
from ipsys_log.log.records import MAGIC, MESSAGE, to_bytes, walk
from ipsys_log.log.summary import Summary, read_intact_summary, tail_bytes

_BLOCK = 1 << 20
_IN_MEMORY = 16 << 20  # bytes of saved messages in memory; more go to an unnamed file


@dataclass(frozen=True, slots=True)
class RepairReport:
    """The result of a repair.

    ``lost`` has the log times in ns of lost messages by topic, ``lost_counts`` their number by topic.
    A number may be known without the times. ``uncounted`` says that an unknown number of other messages may
    be lost. ``unchecked`` counts messages that were saved from damaged chunks without a CRC to confirm them.
    ``bytes_lost`` counts bytes of the data section that cannot be read. ``damaged_file`` is the file with all
    bytes that were taken out of the log. ``cut_off`` says that the log had no end. Then the messages in the
    memory of its writer at the last write (``written_ns``) are lost and unknown.
    """

    path: Path
    changed: bool
    bytes_lost: int
    messages_kept: int
    last_kept_ns: int | None
    lost: Mapping[str, Sequence[int]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    cut_off: bool = False
    written_ns: int = 0
    lost_counts: Mapping[str, int] = field(default_factory=dict)
    uncounted: bool = False
    unchecked: int = 0
    damaged_file: Path | None = None


def repair(path: str | os.PathLike[str], *, storage: Storage = DISK) -> RepairReport:
    """Repair a log in place: keep all whole records, and report the lost messages.

    An interrupted append is rolled back. A whole log is not changed. Damaged ranges become records that
    every reader skips. Their definitions and message indexes are written there again if they are known. The
    readable messages of a damaged chunk are saved in a new chunk. All bytes that are overwritten or cut off
    are kept in ``<path>.damaged`` (``.damaged_2`` if an earlier repair left such a file).

    The new log is read again before the file is changed. Its indexes, its data section and its statistics
    must give the same number of messages. A second repair must find no damage. A whole log is read once, a
    damaged log twice.

    Raises
    ------
    LogError
        The file is empty or no MCAP file, another process is writing it, the disk has no room, or the log
        cannot be repaired. The file is not changed.
    """
    target = Path(path)
    fd = open_locked(storage, target, os.O_RDWR)
    try:
        notes = ["an interrupted append was rolled back"] if roll_back(storage, target, fd) else []
        resumed = resume(storage, target, fd)
        if resumed is not None:
            notes.append("an interrupted repair was completed")
        status = os.fstat(fd)
        view = FileBytes(target, fd, status.st_size, status.st_size)
        _check_not_empty(view)
        known = read_intact_summary(view)
        with tempfile.SpooledTemporaryFile(_IN_MEMORY, dir=str(target.parent)) as spool:
            salvage = Salvage(spool)
            findings = survey(view, known, salvage)
            if findings.unchunked.entries and not findings.crc_is_right and not findings.damaged:
                findings = survey(
                    view, known, salvage, doubtful=True
                )  # there is damage that the survey does not see
            if findings.end < len(MAGIC):
                start = view.read(0, min(len(MAGIC), view.size))
                raise LogError(
                    f"{target} is not an MCAP file (it starts with {start!r}): nothing was changed"
                )
            difference = disagreement(view, findings)
            if not difference:
                total = sum(findings.contents.counts.values())
                return RepairReport(
                    target,
                    bool(notes),
                    0,
                    total,
                    findings.contents.end_ns,
                    notes=tuple(notes),
                    damaged_file=resumed,
                )
            report = _rebuild(storage, view, findings, salvage, known)
        report_notes = report.notes or (f"found: {difference}",)
        return replace(report, notes=(*notes, *report_notes), written_ns=status.st_mtime_ns)
    except OSError as error:
        raise LogError(f"{target} cannot be repaired ({error.strerror}): {disk_advice(error)}") from None
    finally:
        storage.close(fd)


def _check_not_empty(view: FileBytes) -> None:
    if not view.size:
        raise LogError(f"{view.path} is empty: it cannot be repaired; delete it")


class _Plan(NamedTuple):
    """The new log: the patches, the new end, and the number of messages that it must have."""

    patches: list[Patch]
    tail: IO[bytes]
    tail_size: int
    tail_crc: int
    messages: int


def _rebuild(
    storage: Storage, view: FileBytes, findings: Survey, salvage: Salvage, known: Summary | None
) -> RepairReport:
    with tempfile.TemporaryFile(dir=view.path.parent) as tail:
        plan = _plan(view, findings, salvage, tail)
        _check(view, findings, plan)
        new_size = findings.end + plan.tail_size
        own_end = _own_end(view, findings)
        change = Change(plan.patches, findings.end, new_size, plan.tail_crc, own_end, view.size)
        damaged_file = _commit(storage, view, change, plan)
    return _report(view, findings, salvage, known, damaged_file, own_end)


def _plan(view: FileBytes, findings: Survey, salvage: Salvage, tail: IO[bytes]) -> _Plan:
    """Plan the new log; the file is not changed yet."""
    contents, start = findings.contents, findings.end
    patches = _patches(findings)
    end = _End(tail, start, _crc_with(view, patches, start, findings.crc))
    if start == len(MAGIC):
        end.emit(HEADER_RECORD)
    if findings.unindexed is not None:
        data, offsets = index_records(findings.unindexed.entries, end.offset)
        contents.chunks[-1] = contents.chunks[-1]._replace(index_length=len(data), index_offsets=offsets)
        end.emit(data)
    _emit_saved(end, findings, salvage)
    _emit_displaced(end, view, findings)
    findings.definitions.complete()
    contents.schemas, contents.channels = findings.definitions.schemas, findings.definitions.channels
    hashes = b"" if contents.unchunked else metadata_of_hashes(findings.hashes, end.offset)
    if hashes:
        contents.metadata.append(mcap.MetadataIndex(end.offset, len(hashes), METADATA_NAME))
        contents.metadata_count += 1
        end.emit(hashes)
    contents.data_end, contents.data_crc = end.offset, end.data_crc
    end.emit(tail_bytes(contents, index_chunks=not contents.unchunked))
    tail.flush()
    return _Plan(patches, tail, end.offset - start, end.crc, sum(contents.counts.values()))


@dataclass(slots=True)
class _End:
    """The new end of a log while it is built; `data_crc` is the CRC of the data section so far."""

    file: IO[bytes]
    offset: int
    data_crc: int
    crc: int = 0

    def emit(self, data: bytes) -> None:
        self.file.write(data)
        self.offset += len(data)
        self.crc, self.data_crc = zlib.crc32(data, self.crc), zlib.crc32(data, self.data_crc)


def _emit_saved(end: _End, findings: Survey, salvage: Salvage) -> None:
    """Write the saved messages after the definitions of their channels."""
    salvage.finish()
    for record in findings.definitions.missing(set(salvage.counts), salvage.inside):
        end.emit(to_bytes(record))
    contents, base = findings.contents, end.offset
    salvage.spool.seek(0)
    while block := salvage.spool.read(_BLOCK):
        end.emit(block)
    for ref in salvage.chunks:
        offsets = {channel: offset + base for channel, offset in ref.index_offsets.items()}
        contents.chunks.append(ref._replace(offset=ref.offset + base, index_offsets=offsets))
        contents.cover(ref.start_ns, ref.end_ns)
    for channel, number in salvage.counts.items():
        contents.count(channel, number)


def _emit_displaced(end: _End, view: FileBytes, findings: Survey) -> None:
    """Write messages outside of chunks that cannot stay in place, after the definitions of their channels."""
    contents = findings.contents
    heads = [MESSAGE.unpack(view.read(record_at.offset, MESSAGE.size)) for record_at in findings.displaced]
    for record in findings.definitions.missing({head[2] for head in heads}, findings.definitions.known):
        end.emit(to_bytes(record))
    for record_at, (_, _, channel, _, time_ns, _) in zip(findings.displaced, heads, strict=True):
        contents.unchunked.setdefault(channel, []).append((time_ns, end.offset))
        contents.count(channel, 1)
        contents.cover(time_ns, time_ns)
        end.emit(view.read(record_at.offset, record_at.length))


def _patches(findings: Survey) -> list[Patch]:
    chunks = findings.contents.chunks
    for damaged_range in findings.damaged:
        if damaged_range.chunk is not None:
            data, offsets = damaged_range.indexes()
            chunks[damaged_range.chunk] = chunks[damaged_range.chunk]._replace(
                index_length=len(data), index_offsets=offsets
            )
    patches = [(damaged_range.offset, damaged_range.content()) for damaged_range in findings.damaged]
    return sorted([*patches, *findings.wrong_heads])


def _crc_with(view: FileBytes, patches: Sequence[Patch], end: int, crc: int) -> int:
    """Return the CRC of the data section up to `end` after `patches`: it is linear in the changed bytes."""
    for offset, new in patches:
        differs = zlib.crc32(view.read(offset, len(new))) ^ zlib.crc32(new)
        crc ^= combine(differs, 0, end - offset - len(new))
    return crc


def _check(view: FileBytes, findings: Survey, plan: _Plan) -> None:
    """Check the new log before it is written: by its indexes, record by record, and by its statistics.

    Raises
    ------
    LogError
        The numbers of messages do not agree.
    """
    size = findings.end + plan.tail_size
    new = FileBytes(view.path, view.fd, size, findings.end, plan.tail.fileno(), 0, patches=plan.patches)
    new_findings = survey(new, read_intact_summary(new))
    streamed = sum(new_findings.contents.counts.values())
    difference = disagreement(new, new_findings)
    if not difference and not plan.messages == streamed == count_by_indexes(new):
        difference = f"{plan.messages} messages would be saved, but {streamed} can be read"
    if difference:
        faults = "; ".join(findings.faults[:3])
        raise LogError(
            f"{view.path} cannot be repaired ({difference}) and was not changed. Keep a copy of it. "
            f"Found: {faults}"
        )


class _FileBlocks(Sequence[bytes]):
    """A file as blocks of bytes, read when they are needed."""

    def __init__(self, fd: int, size: int) -> None:
        self._fd, self._size = fd, size

    def __len__(self) -> int:
        return len(range(0, self._size, _BLOCK))

    @overload
    def __getitem__(self, index: int) -> bytes: ...
    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...
    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        if not 0 <= index < len(self):
            raise IndexError(index)
        return os.pread(self._fd, _BLOCK, index * _BLOCK)


def _commit(storage: Storage, view: FileBytes, change: Change, plan: _Plan) -> Path | None:
    """Keep the old bytes, then write the new log; a crash at any instant leaves the old or the new log."""
    path, fd = view.path, view.fd
    check_room(path, change)
    has_old_bytes = keep_old_bytes(storage, view, change, os.fstat(fd).st_mtime_ns)
    try:
        replace_tail(storage, path, fd, change.start, _FileBlocks(plan.tail.fileno(), plan.tail_size))
    except BaseException:  # a disk error, or an interrupt
        with suppress(OSError):  # after a failure the next writer rolls back
            roll_back(storage, path, fd)
            discard(storage, path, fd)
        raise
    return overwrite(storage, path, fd, change.patches) if has_old_bytes else None


def _own_end(view: FileBytes, findings: Survey) -> int:
    """Return the end of a finished log; later bytes are not a part of the log."""
    if findings.finished:
        with suppress(LogError):
            for record_at in walk(view, findings.end, view.size):
                if record_at.opcode == Opcode.FOOTER:
                    return min(record_at.offset + record_at.length + len(MAGIC), view.size)
    return view.size


def _report(
    view: FileBytes,
    findings: Survey,
    salvage: Salvage,
    known: Summary | None,
    damaged_file: Path | None,
    own_end: int,
) -> RepairReport:
    contents = findings.contents
    notes = [f"found: {fault}" for fault in findings.faults]
    if findings.finished and not findings.crc_is_right and not findings.damaged:
        notes.append("found: the CRC of the data section is wrong; the position of the damage is unknown")
    if own_end < view.size:
        notes.append(f"{view.size - own_end} bytes after its end (perhaps another log) were cut off")
    lost_counts, counted = _count_lost(findings, known)
    # Without a CRC and a summary, a removal of whole records cannot be detected.
    is_unsure = findings.finished and not (findings.has_crc and findings.crc_is_right)
    return RepairReport(
        view.path,
        True,
        findings.lost.bytes - sum(record_at.length for record_at in findings.displaced) + view.size - own_end,
        sum(contents.counts.values()),
        contents.end_ns,
        findings.lost.times_ns,
        tuple(notes),
        cut_off=not findings.finished and known is None,
        lost_counts=lost_counts,
        uncounted=not counted and (findings.lost.uncounted > 0 or is_unsure),
        unchecked=salvage.unchecked,
        damaged_file=damaged_file,
    )


def _count_lost(findings: Survey, known: Summary | None) -> tuple[dict[str, int], bool]:
    """Return the number of lost messages by topic, and whether the summary confirms these numbers."""
    lost_counts = {topic: len(times_ns) for topic, times_ns in findings.lost.times_ns.items()}
    if known is None or not known.checked or known.statistics is None:
        return lost_counts, False
    for channel, number in known.statistics.channel_message_counts.items():
        record = known.contents.channels.get(channel)
        missing = number - findings.contents.counts.get(channel, 0)
        if missing > 0:
            topic = record.topic if record else f"channel {channel}"
            lost_counts[topic] = max(lost_counts.get(topic, 0), missing)
    return lost_counts, True
