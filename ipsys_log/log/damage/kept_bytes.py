"""Storage of the bytes that a repair takes out of a log, and the state of an unfinished repair.

``<log>.damaged`` is an MCAP file. Its attachments are the bytes that were overwritten or cut off, each named
after its byte range in the damaged log. If they are written back there, the damaged log is restored. The
metadata record of the file lists the new bytes. Until the repair is complete, the file has the name
``<log>.damaged.partial``:

- the old log is valid until the new end of the log is in place (the journal is removed);
- after that the new log is valid. Only then the repair overwrites the bytes before the new end. If this is
  interrupted, the next repair completes it.
"""

import os
import shutil
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import FileBytes, open_for_reading
from ipsys_log.log.contents import Contents
from ipsys_log.log.damage.resync import crc_of
from ipsys_log.log.journal import Storage, write_all
from ipsys_log.log.records import HEADER, MAGIC, parse, to_bytes, walk
from ipsys_log.log.summary import read_summary, tail_bytes
from ipsys_log.units import format_bytes

Patch = tuple[int, bytes]  # offset in the log, new bytes

_METADATA_NAME = "ipsys repair"
_BLOCK = 1 << 20
_SMALL = 64 << 10  # bytes: for heads and summaries


@dataclass(frozen=True, slots=True)
class Change:
    """The changes of a repair: overwrite `patches`, and replace the end of the log.

    The new end begins at `start`. `new_size` is the size of the log afterwards, `crc` the CRC-32 of its new
    end. `own_end` is the end of the damaged log: later bytes are not a part of the log.
    """

    patches: Sequence[Patch]
    start: int
    new_size: int
    crc: int
    own_end: int
    old_size: int

    @property
    def old_pieces(self) -> list[tuple[int, int]]:
        """The offset and the end of each range of old bytes that the repair takes out."""
        pieces = [(offset, offset + len(new)) for offset, new in self.patches]
        pieces += [(self.start, self.own_end), (self.own_end, self.old_size)]
        return [(start, end) for start, end in pieces if end > start]


def check_room(path: Path, change: Change) -> None:
    """Refuse a repair for which the disk has no room, before any change.

    Raises
    ------
    LogError
        The old bytes, the journal and the new end do not fit.
    """
    old = sum(end - start for start, end in change.old_pieces)
    growth = max(0, change.new_size - change.old_size)
    needed = 2 * old + growth + _SMALL  # the journal holds the old end once more, for a while
    free = shutil.disk_usage(_beside(path, "").parent).free
    if free < needed:
        raise LogError(
            f"{path} cannot be repaired: a second file must keep the removed {format_bytes(old)}. "
            f"This needs {format_bytes(needed)}, but only {format_bytes(free)} are free: free some space"
        )


def keep_old_bytes(storage: Storage, view: FileBytes, change: Change, time_ns: int) -> bool:
    """Write ``<log>.damaged.partial`` and sync it; return False if no bytes are taken out."""
    if not change.old_pieces:
        return False
    path = _beside(view.path, ".damaged.partial")
    fd = storage.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        _write(storage, fd, view, change, time_ns)
        storage.fsync(fd)
    except OSError:
        with suppress(OSError):
            storage.unlink(path)
        raise
    finally:
        storage.close(fd)
    storage.fsync_directory(path.parent)
    return True


def discard(storage: Storage, path: Path, fd: int) -> None:
    """Remove the file of `keep_old_bytes` after a failed repair, unless the new end is in place."""
    partial = _beside(path, ".damaged.partial")
    with suppress(OSError):
        if _committed_patches(partial, path, fd) is None:
            storage.unlink(partial)


def overwrite(storage: Storage, path: Path, fd: int, patches: Sequence[Patch]) -> Path:
    """Overwrite the damaged ranges of a log after its new end is in place; return ``<log>.damaged``."""
    for offset, new in patches:
        write_all(storage, fd, new, offset)
    if patches:
        storage.fsync(fd)
    kept_path, number = _beside(path, ".damaged"), 1
    while kept_path.exists():  # from an earlier repair
        number += 1
        kept_path = _beside(path, f".damaged_{number}")
    storage.rename(_beside(path, ".damaged.partial"), kept_path)
    storage.fsync_directory(kept_path.parent)
    return kept_path


def resume(storage: Storage, path: Path, fd: int) -> Path | None:
    """Complete a repair if its new end is in place, else discard it.

    Return ``<log>.damaged`` if a repair was completed, else None. The caller holds the exclusive lock.
    """
    partial = _beside(path, ".damaged.partial")
    if not partial.exists():
        return None
    patches = _committed_patches(partial, path, fd)
    if patches is None:
        storage.unlink(partial)
        return None
    return overwrite(storage, path, fd, patches)


def _committed_patches(partial: Path, path: Path, fd: int) -> list[Patch] | None:
    try:
        values = _read_metadata(partial)
        start, new_size, crc = (int(values[key]) for key in ("start", "new_size", "crc"))
        patches = [
            (int(key.removeprefix("bytes ")), bytes.fromhex(value))
            for key, value in values.items()
            if key.startswith("bytes ")
        ]
    except (LogError, KeyError, ValueError):  # the file is incomplete: so the log was not changed
        return None
    size = os.fstat(fd).st_size
    log = FileBytes(path, fd, size, size)
    if size < new_size or crc_of(log, new_size - start, start) != crc:
        return None
    return patches


def _read_metadata(partial: Path) -> dict[str, str]:
    fd = open_for_reading(partial)
    try:
        size = os.fstat(fd).st_size
        view = FileBytes(partial, fd, size, size)
        summary = read_summary(view)
        if summary is None:
            return {}
        for index in summary.contents.metadata:
            record_at = next(walk(view, index.offset, size))
            body = view.read(record_at.offset + HEADER.size, record_at.length - HEADER.size)
            return dict(parse(mcap.Metadata.read, view, record_at, body).metadata)
        return {}
    finally:
        os.close(fd)


def _write(storage: Storage, fd: int, view: FileBytes, change: Change, time_ns: int) -> None:
    contents, crc, offset = Contents(), 0, 0

    def emit(data: bytes) -> None:
        nonlocal crc, offset
        write_all(storage, fd, data, offset)
        crc, offset = zlib.crc32(data, crc), offset + len(data)

    emit(MAGIC + to_bytes(mcap.Header("", "ipsys 1")))
    for start, end in change.old_pieces:
        name, begin = f"bytes {start} to {end}", offset
        for data in _attachment(view, name, start, end, time_ns):
            emit(data)
        contents.attachments.append(
            mcap.AttachmentIndex(begin, offset - begin, time_ns, time_ns, end - start, name, "")
        )
    contents.attachment_count = len(contents.attachments)
    values = {"start": str(change.start), "new_size": str(change.new_size), "crc": str(change.crc)}
    values |= {f"bytes {patch_offset}": new.hex() for patch_offset, new in change.patches}
    metadata = to_bytes(mcap.Metadata(_METADATA_NAME, values))
    contents.metadata.append(mcap.MetadataIndex(offset, len(metadata), _METADATA_NAME))
    contents.metadata_count = 1
    emit(metadata)
    contents.data_end, contents.data_crc = offset, crc
    emit(tail_bytes(contents))


def _attachment(view: FileBytes, name: str, start: int, end: int, time_ns: int) -> Iterator[bytes]:
    """Yield an Attachment record, block by block."""
    text = name.encode()
    fields = struct.pack("<QQI", time_ns, time_ns, len(text)) + text + struct.pack("<IQ", 0, end - start)
    yield HEADER.pack(Opcode.ATTACHMENT, len(fields) + end - start + 4) + fields
    crc = zlib.crc32(fields)
    for offset in range(start, end, _BLOCK):
        data = view.read(offset, min(_BLOCK, end - offset))
        crc = zlib.crc32(data, crc)
        yield data
    yield struct.pack("<I", crc)


def _beside(path: Path, suffix: str) -> Path:
    """Return the path of a file beside the log itself, also if the log is opened through a link."""
    real = Path(os.path.realpath(path)) if path.is_symlink() else path
    return real.with_name(real.name + suffix)
