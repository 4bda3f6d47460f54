"""Recovery of a log whose writer was killed, whose end was cut off, or which is damaged.

An unfinished log is completed in place: the readable messages after its last whole record are appended, as
in any other append. Every other log is copied into a new log beside it, which takes its name at the end.
"""

import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from ipsys_log.errors import LogError, disk_advice
from ipsys_log.log.byte_source import FileBytes, open_for_reading
from ipsys_log.log.file_check import disagreement
from ipsys_log.log.journal import DISK, Storage, open_locked, roll_back, write_all
from ipsys_log.log.output import SMALL_APPENDED, PendingAppend
from ipsys_log.log.part_copier import PartCopier
from ipsys_log.log.records import MAGIC, index_records
from ipsys_log.log.summary import load_contents, read_intact_summary
from ipsys_log.log.survey import Kind, Survey
from ipsys_log.log.writer import LogWriter
from ipsys_log.units import format_bytes

_BLOCK = 1 << 20
_MOST_IN_MEMORY = 64 << 20  # bytes: a longer end of an unfinished log is copied with the rest
_SPARE_BYTES = 1 << 20  # for larger indexes than in the old log
_LOST = "/lost"


@dataclass(frozen=True, slots=True)
class RepairReport:
    """The result of a repair.

    ``lost`` has the log times in ns of lost messages by topic, ``lost_counts`` their number by topic.
    A number may be known without the times. ``uncounted`` says that an unknown number of other messages may
    be lost. ``unchecked`` counts messages from damaged parts that no CRC confirms.
    ``bytes_lost`` counts bytes that cannot be read. ``damaged_file`` is the old log, or only its end if the
    rest did not change. ``cut_off`` says that the log had no end. Then the messages in the memory of its
    writer at the last write (``written_ns``) are lost and unknown.
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
    """Repair a log: keep everything that can be read, and report the lost messages.

    An interrupted append is rolled back. A whole log is not changed. A log with damage only at its end is
    completed in place. Any other log is copied into ``<path>.recovered.partial``, which is checked and then
    takes its name. ``<path>.damaged`` keeps the old log, or only its end (``.damaged_2`` if it exists).

    Messages in damaged parts are kept if they can be read, although no CRC confirms them. In a new log, an
    event names their range.

    Raises
    ------
    LogError
        The file is empty or no MCAP file, another process is writing it, the disk has no room, or the log
        cannot be repaired. The file is not changed.
    """
    target = Path(os.path.realpath(path)) if Path(path).is_symlink() else Path(path)
    fd = open_locked(storage, target, os.O_RDWR)
    try:
        notes = ["an interrupted append was rolled back"] if roll_back(storage, target, fd) else []
        status = os.fstat(fd)
        view = FileBytes(target, fd, status.st_size, status.st_size)
        survey = _survey(view)
        difference = disagreement(view, survey)
        if not difference:
            kept = survey.contents
            total = sum(kept.counts.values())
            return RepairReport(Path(path), bool(notes), 0, total, kept.end_ns, notes=tuple(notes))
        recover = _complete if _is_whole_before_end(survey) else _replace
        copier, damaged_file = recover(storage, view, survey)
        notes += [f"found: {text}" for _, text in survey.faults] or [f"found: {difference}"]
        if survey.log_end < view.size:
            notes.append(
                f"{view.size - survey.log_end} bytes after its end (perhaps another log) were cut off"
            )
        report = _report(Path(path), view.size, survey, copier)
        return replace(report, notes=tuple(notes), written_ns=status.st_mtime_ns, damaged_file=damaged_file)
    except OSError as error:
        raise LogError(f"{target} cannot be repaired ({error.strerror}): {disk_advice(error)}") from None
    finally:
        storage.close(fd)


def _survey(view: FileBytes) -> Survey:
    if not view.size:
        raise LogError(f"{view.path} is empty: it cannot be repaired; delete it")
    survey = Survey(view, read_intact_summary(view))
    start = view.read(0, min(len(MAGIC), view.size))
    if start != MAGIC and all(part.kind == Kind.DAMAGE for part in survey.parts):
        raise LogError(f"{view.path} is not an MCAP file (it starts with {start!r}): nothing was changed")
    return survey


def _is_whole_before_end(survey: Survey) -> bool:
    """Return whether a log can be completed in place: all its chunks are before the first damage."""
    later = [part for part in survey.parts if part.start >= survey.end]
    is_unfinished = not survey.finished and all(part.kind != Kind.CHUNK for part in later)
    is_short = survey.view.size - survey.end < _MOST_IN_MEMORY
    return survey.end > len(MAGIC) and (survey.end == survey.data_end or (is_unfinished and is_short))


def _complete(storage: Storage, view: FileBytes, survey: Survey) -> tuple[PartCopier, Path | None]:
    """Complete a log in place: append the readable messages after `survey.end`, and a new summary."""
    path, end, contents = view.path, survey.end, survey.contents.copy()
    damaged_file = _keep_end(storage, view, end) if end < view.size else None
    try:
        output = PendingAppend(
            storage, path, os.dup(view.fd), view.size, end, end, survey.crc, lambda at: b"\0", is_forced=True
        )
        if survey.unindexed is not None:
            data, offsets = index_records(survey.unindexed.entries, end)
            output.emit(data)
            contents.chunks[-1] = contents.chunks[-1]._replace(index_length=len(data), index_offsets=offsets)
        with LogWriter(path, output, contents, SMALL_APPENDED, survey.hashes) as writer:
            copier = PartCopier(view, survey, writer)
            copier.copy([part for part in survey.parts if part.start >= end])
    except BaseException:
        if damaged_file is not None and os.fstat(view.fd).st_size == view.size:
            with suppress(OSError):
                storage.unlink(damaged_file)
        raise
    return copier, damaged_file


def _keep_end(storage: Storage, view: FileBytes, start: int) -> Path:
    """Write the bytes from `start` on into a file beside the log."""
    path = _free_name(view.path)
    _check_room(view.path, 3 * (view.size - start))  # this file, the journal, and the new end
    fd = storage.open(path, os.O_WRONLY | os.O_CREAT)
    try:
        for offset in range(start, view.size, _BLOCK):
            write_all(storage, fd, view.read(offset, min(_BLOCK, view.size - offset)), offset - start)
        storage.fsync(fd)
    finally:
        storage.close(fd)
    storage.fsync_directory(path.parent)
    return path


def _replace(storage: Storage, view: FileBytes, survey: Survey) -> tuple[PartCopier, Path]:
    """Copy all readable parts into a new log, check it, and give it the name of the old one."""
    path, new = view.path, view.path.with_name(view.path.name + ".recovered.partial")
    _check_room(path, view.size)
    if new.exists():  # an earlier repair was interrupted
        storage.unlink(new)
    try:
        with LogWriter.create(new, storage=storage) as writer:
            copier = PartCopier(view, survey, writer, is_new=True)
            copier.define_all()
            copier.copy(survey.parts)
        _check_new(path, new)
        if not os.path.samestat(os.fstat(view.fd), path.stat()):
            raise LogError(
                f"{path}: another program has replaced the log in the meantime; run the command again"
            )
        shutil.copymode(path, new)
        damaged_file = _free_name(path)
        if not damaged_file.exists():
            try:
                storage.link(path, damaged_file)
            except OSError:  # a file system without hard links: for an instant, the log has only this name
                storage.rename(path, damaged_file)
        storage.fsync_directory(path.parent)
        storage.rename(new, path)
        storage.fsync_directory(path.parent)
    except BaseException:
        with suppress(OSError):
            storage.unlink(new)
        raise
    return copier, damaged_file


def _check_room(path: Path, needed: int) -> None:
    free = shutil.disk_usage(path.parent).free
    if free < needed + _SPARE_BYTES:
        raise LogError(
            f"{path} cannot be repaired: the old data are kept in a second file. This needs "
            f"{format_bytes(needed + _SPARE_BYTES)}, but only {format_bytes(free)} are free: free some space"
        )


def _check_new(path: Path, new: Path) -> None:
    """Check that a new log has no fault: a second repair would not change it."""
    fd = open_for_reading(new)
    try:
        size = os.fstat(fd).st_size
        view = FileBytes(new, fd, size, size)
        difference = disagreement(view, Survey(view, read_intact_summary(view)))
    finally:
        os.close(fd)
    if difference:
        raise LogError(f"{path} cannot be repaired ({difference}) and was not changed. Keep a copy of it")


def _free_name(path: Path) -> Path:
    """Return the path of the file for the old data; an earlier repair may have left one."""
    name, number = path.with_name(f"{path.name}.damaged"), 1
    while name.exists() and not name.samefile(path):  # the same file: that repair was interrupted
        number += 1
        name = path.with_name(f"{path.name}.damaged_{number}")
    return name


def _report(path: Path, old_size: int, survey: Survey, copier: PartCopier) -> RepairReport:
    fd = open_for_reading(path)
    try:
        size = os.fstat(fd).st_size
        contents = load_contents(FileBytes(path, fd, size, size))
    finally:
        os.close(fd)
    lost: dict[str, list[int]] = {}
    for channel_id, time_ns in copier.lost.elements():
        lost.setdefault(survey.topic(channel_id), []).append(time_ns)
    lost_counts = {topic: len(times_ns) for topic, times_ns in lost.items()}
    statistics = survey.known.statistics if survey.known is not None and survey.known.checked else None
    if statistics is not None:
        missing = Counter[str]()
        for channel_id, number in statistics.channel_message_counts.items():
            missing[survey.topic(channel_id)] += number
        for channel_id, number in contents.counts.items():
            missing[contents.channels[channel_id].topic] -= number
        lost_counts |= {topic: number for topic, number in missing.items() if number > 0}
    damage = [part for part in survey.parts if part.kind == Kind.DAMAGE]
    return RepairReport(
        path,
        True,
        sum(part.end - part.start for part in damage) + old_size - survey.log_end,
        sum(contents.counts.values()),
        contents.end_ns,
        {topic: sorted(times_ns) for topic, times_ns in lost.items()},
        cut_off=not survey.finished and survey.known is None,
        lost_counts=lost_counts,
        # Without a CRC and a summary, a removal of whole records cannot be detected.
        uncounted=statistics is None and (survey.finished or _is_uncounted(survey)),
        unchecked=copier.unchecked,
    )


def _is_uncounted(survey: Survey) -> bool:
    """Return whether damage may hold messages that no message index names."""
    is_uncounted = in_damage = False
    for part in survey.parts:
        if part.kind == Kind.CHUNK:
            is_uncounted, in_damage = is_uncounted or in_damage, False
        in_damage = (in_damage or part.kind == Kind.DAMAGE) and not part.lost
    return is_uncounted or in_damage
