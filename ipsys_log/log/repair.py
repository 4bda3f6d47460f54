"""Making a log whole again whose writer was killed, or whose end was cut off."""

import os
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.bounds import BoundError
from ipsys_log.log.contents import Contents
from ipsys_log.log.crc import Buffer
from ipsys_log.log.hashing import METADATA_NAME, metadata_of_hashes
from ipsys_log.log.journal import replace_tail, roll_back
from ipsys_log.log.load import load_contents
from ipsys_log.log.lock import open_locked
from ipsys_log.log.records import HEADER, MAGIC, ChunkRef, as_bytes, walk
from ipsys_log.log.salvage import Salvage, salvage
from ipsys_log.log.storage import DISK, Storage, write_all
from ipsys_log.log.summary import tail_bytes
from ipsys_log.log.survey import Survey, crc_of, survey
from ipsys_log.log.view import View

__all__ = ["RepairReport", "repair"]

_KEEP_BESIDE = 16 << 20  # bytes: a larger stretch that cannot be read is copied before it is cut off
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class RepairReport:
    """What `repair` found and did.

    ``lost`` has, by topic, the log times in ns of messages known to be gone; ``bytes_lost`` counts bytes of
    the data section that were dropped. ``cut_off`` says that the log had no end: what its writer had not
    handed over yet when the file was last written, at ``written_ns``, is gone and not known.
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


def repair(path: str | os.PathLike[str], *, storage: Storage = DISK) -> RepairReport:
    """Restore every complete chunk of a log in place, and say what was lost.

    An append that was cut short is rolled back. A log that is whole is left alone. Damaged chunks in the
    middle are marked so that readers skip them. What is dropped in one piece and is larger than 16 MiB is
    kept in ``<path>.lost``.

    Raises
    ------
    LogError
        The file is empty or not an MCAP, or another process is writing it.
    """
    target = Path(path)
    fd = open_locked(storage, target, os.O_RDWR)
    try:
        rolled_back = roll_back(storage, target, fd)
        status = os.fstat(fd)
        size = status.st_size
        view = View(target, fd, size, size)
        _check_magic(view)
        known = _summary(view)
        found = survey(view, known)
        notes = ["an append that was cut short was rolled back"] if rolled_back else []
        if known is not None and _is_whole(known, found):
            return RepairReport(
                target,
                rolled_back,
                0,
                sum(found.contents.counts.values()),
                found.contents.end_ns,
                {},
                tuple(notes),
            )
        return replace(_rebuild(storage, view, found, notes), written_ns=status.st_mtime_ns)
    except OSError as error:
        raise LogError(
            f"{target} cannot be repaired ({error.strerror}): free some space and try again"
        ) from None
    finally:
        storage.close(fd)


def _check_magic(view: View) -> None:
    start = view.read(0, min(len(MAGIC), view.size))
    if not start:
        raise LogError(f"{view.path} is empty: there is nothing to repair, delete it")
    if start != MAGIC:
        raise LogError(f"{view.path} is not an MCAP file (it starts with {start!r}): nothing was changed")


def _summary(view: View) -> Contents | None:
    try:
        return load_contents(view)
    except BoundError:
        raise
    except LogError:
        return None


def _is_whole(theirs: Contents, found: Survey) -> bool:
    if not found.finished or found.damaged or not found.crc_is_right:
        return False
    mine = found.contents
    chunks = [_identity(chunk) for chunk in mine.chunks] == [_identity(chunk) for chunk in theirs.chunks]
    indexes = all(
        b.index_offsets in ({}, a.index_offsets) for a, b in zip(mine.chunks, theirs.chunks, strict=False)
    )
    counts = Counter(mine.counts) == Counter(theirs.counts)
    return chunks and indexes and counts and theirs.data_end == found.end


def _identity(chunk: ChunkRef) -> tuple[int | str, ...]:
    """All that a reader goes by, but for the message indexes."""
    sizes = (chunk.length, chunk.compressed_size, chunk.uncompressed_size)
    return (chunk.offset, chunk.start_ns, chunk.end_ns, chunk.compression, *sizes)


def _rebuild(storage: Storage, view: View, found: Survey, notes: list[str]) -> RepairReport:
    """Cut behind the last whole record, write what was saved, and a new summary."""
    contents, size, start = found.contents, view.size, found.end
    saved = Salvage() if found.finished else salvage(view, start, found)
    bytes_lost = 0 if found.finished else max(0, size - start - saved.bytes_kept)
    bytes_lost += sum(record.length for record in found.damaged)
    behind = _own_end(view, found)
    if behind < size:
        bytes_lost += size - behind
        kept_in = _copy_lost(storage, view, behind)
        notes.append(f"{size - behind} bytes behind its end, perhaps another log, were kept in {kept_in}")
    if not found.finished and size - start > _KEEP_BESIDE:
        notes.append(
            f"the {size - start} bytes from byte {start} on were kept in {_copy_lost(storage, view, start)}"
        )
    _blank(storage, view, found)
    indexes = b"".join(_indexes(found))
    kept = b"".join((indexes, *_saved_chunk(found, saved, start + len(indexes))))
    contents.data_end = start + len(kept)
    hashes = b"" if contents.loose else metadata_of_hashes(found.hashes, contents.data_end)
    if hashes:
        contents.metadata.append(mcap.MetadataIndex(contents.data_end, len(hashes), METADATA_NAME))
        contents.metadata_count += 1
        contents.data_end += len(hashes)
    contents.data_crc = zlib.crc32(kept + hashes, found.crc)
    replace_tail(storage, view.path, view.fd, start, (kept, hashes, tail_bytes(contents)))
    notes += [f"found: {fault}" for fault in found.faults]
    kept_messages = sum(contents.counts.values())
    lost, whole = found.lost.times_ns, found.finished
    return RepairReport(
        view.path, True, bytes_lost, kept_messages, contents.end_ns, lost, tuple(notes), not whole
    )


def _own_end(view: View, found: Survey) -> int:
    """Where a finished log ends; what lies behind that is not its own."""
    if found.finished:
        with suppress(LogError):
            for at in walk(view, found.end, view.size):
                if at.opcode == Opcode.FOOTER:
                    return min(at.offset + at.length + len(MAGIC), view.size)
    return view.size


def _indexes(found: Survey) -> list[bytes]:
    """The missing message indexes of the last chunk."""
    if found.unindexed is None:
        return []
    chunk = found.contents.chunks[-1]
    at, offsets, pieces = found.end, {}, []
    for channel, rows in found.unindexed.entries.items():
        pieces.append(as_bytes(mcap.MessageIndex(channel, rows)))
        offsets[channel], at = at, at + len(pieces[-1])
    found.contents.chunks[-1] = ChunkRef(
        chunk.offset, chunk.length, chunk.start_ns, chunk.end_ns, chunk.compression, chunk.compressed_size,
        chunk.uncompressed_size, at - found.end, offsets,
    )  # fmt: skip
    return pieces


def _saved_chunk(found: Survey, saved: Salvage, offset: int) -> list[Buffer]:
    built = saved.chunk.build(offset + sum(map(len, saved.definitions)))
    if built is None:
        return [*saved.definitions]
    ref, data, _ = built
    found.contents.chunks.append(ref)
    found.contents.cover(ref.start_ns, ref.end_ns)
    for channel, number in saved.chunk.counts.items():
        found.contents.count(channel, number)
    return [*saved.definitions, data]


def _blank(storage: Storage, view: View, found: Survey) -> None:
    """Make damaged stretches records of a private type, which every reader skips."""
    for stretch in found.damaged:
        head = HEADER.pack(Opcode.CHUNK | 0x80, stretch.length - HEADER.size)
        write_all(storage, view.fd, head, stretch.offset)
    if found.damaged:
        storage.fsync(view.fd)
        found.crc = crc_of(view, found.end)


def _copy_lost(storage: Storage, view: View, start: int) -> Path:
    beside, number = view.path.with_name(view.path.name + ".lost"), 1
    while beside.exists():  # of an earlier repair, or one that was interrupted
        number += 1
        beside = view.path.with_name(f"{view.path.name}.lost_{number}")
    fd = storage.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    try:
        for offset in range(start, view.size, _BLOCK):
            write_all(storage, fd, view.read(offset, min(_BLOCK, view.size - offset)), offset - start)
        storage.fsync(fd)
    finally:
        storage.close(fd)
    storage.fsync_directory(beside.parent)
    return beside
