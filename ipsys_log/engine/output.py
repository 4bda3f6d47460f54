"""Output of messages to logs: to a new log, or as a run at the end of a log."""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.atomic_files import partial_of
from ipsys_log.log.codec import encode, schema_data, schema_name
from ipsys_log.log.contents import Schema
from ipsys_log.log.dataset import Session
from ipsys_log.log.journal import DISK, journal_path
from ipsys_log.log.location import LogLocation, LogUrl, describe_broken_link, is_one_of
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import ChannelWritten, Message, Rig, Run, kind_of
from ipsys_log.messages.rig_file import hide_passwords


def write_messages(writer: LogWriter, messages: Iterable[Message]) -> dict[str, int]:
    """Write messages to an open log; return the number of messages by topic."""
    counts: dict[str, int] = {}
    for message in messages:
        write_message(writer, message, counts)
    return counts


def serialize(message: Message) -> bytes:
    """Return the bytes of a message in a log. Passwords are removed."""
    return encode(hide_passwords(message.payload) if isinstance(message.payload, Rig) else message.payload)


def write_message(
    writer: LogWriter, message: Message, counts: dict[str, int], data: bytes | None = None
) -> None:
    """Write a message to an open log, and count it by its topic; ``data`` is that of :func:`serialize`."""
    name = schema_name(kind_of(message.payload))
    # A camera can begin to send another message type: this check refuses another schema on a known topic.
    if message.topic not in counts or message.camera is not None:
        writer.add_channel(message.topic, Schema(name, "protobuf", schema_data(name)))
    writer.write(message.topic, message.log_time_ns, message.publish_time_ns, data or serialize(message))
    counts[message.topic] = counts.get(message.topic, 0) + 1


def write_log(path: Path, messages: Iterable[Message]) -> dict[str, int]:
    """Write a new log; after an error, delete it.

    Returns
    -------
    The number of messages by topic.
    """
    with LogWriter.create(path, atomic=True) as writer:
        return write_messages(writer, messages)


def check_copy(paths: Sequence[LogLocation], output: Path, overwrite: bool) -> None:
    """Refuse an output that is one of the logs, or that exists, except with ``overwrite``."""
    if not output.exists():
        return
    if is_one_of(output, paths):
        raise IpsysError(f"-o {output}: this is the log itself; choose another name")
    if not overwrite:
        raise IpsysError(f"-o {output}: exists already; choose another name, or give --overwrite")


@contextmanager
def create_copy(output: Path, overwrite: bool) -> Iterator[LogWriter]:
    """Yield the writer of a log that is made from other logs; it gets its name when it is complete."""
    with LogWriter.create(output, atomic=True, overwrite=overwrite) as writer:
        yield writer


def append_run(
    path: Path,
    record: Run,
    log_time_ns: int,
    messages: Callable[[], Iterable[Message]],
    held: Mapping[str, int],
) -> Run:
    """Append the messages of a stage and then its record in one step: the log gets all of them, or none.

    ``messages`` is called when the log is locked, so that no two processes do the same work; ``held`` is the
    number of messages by topic that the run already has.

    Raises
    ------
    LogError
        Another process has written to this run in the meantime.
    """
    with LogWriter.append(path) as writer:
        with Session([path]) as now:
            if any((run.run, run.stage) == (record.run, record.stage) for run in now.runs()):
                raise LogError(f"{path}: another process has just written run {record.run}; start again")
        counts = Counter(held) + Counter(write_messages(writer, messages()))
        outputs = tuple(ChannelWritten(topic, count) for topic, count in sorted(counts.items()))
        done = replace(record, outputs=outputs)
        write_messages(writer, [record_message(done, log_time_ns)])
    return done


def append_messages(path: Path, messages: Iterable[Message]) -> None:
    """Append messages to a log: all of them or none."""
    with LogWriter.append(path) as writer:
        write_messages(writer, messages)


def record_message(record: Run, log_time_ns: int) -> Message:
    return Message(f"/runs/{record.run}/record", log_time_ns, record.timestamp, record)


def choose_target(
    paths: Sequence[LogLocation], output: Path | None, folder: Path | None = None
) -> tuple[list[LogLocation], Path | None]:
    """Return the logs to read, and the new log for the results; None if they are appended to the last log.

    Nothing can be appended to a log at a URL, or to a file without write permission. Its results come into a
    derived log: ``monday.derived.mcap`` for ``monday.mcap``. A derived log that exists is read, too, and
    extended.

    Parameters
    ----------
    folder : of derived logs. The logs of a pattern keep their folders below it. None: the working folder.

    Raises
    ------
    IpsysError
        The derived log has results of another log.
    """
    if output is not None:
        return list(paths), output
    derived = derived_log_of(paths[-1], folder)
    if derived is None or not derived.exists():
        return list(paths), derived
    check_source(paths, derived)
    return [*paths, derived], None


def derived_log_of(source: LogLocation, folder: Path | None = None) -> Path | None:
    """Return the derived log of a log, which may not exist yet; None if the log gets its results itself."""
    if isinstance(source, Path) and _can_append(source):
        return None
    return _derived_log(source, folder)


def logs_with_results(source: LogLocation, folder: Path | None = None) -> list[LogLocation]:
    """Return a log, and its derived log in a folder if there is one, as :func:`choose_target` names it."""
    return choose_target([source], None, folder)[0]


def _can_append(log: Path) -> bool:
    """Return whether a log, and the journal beside it, can be written. A missing log is another error."""
    return not log.exists() or (os.access(log, os.W_OK) and os.access(log.absolute().parent, os.W_OK))


def _derived_log(source: LogLocation, folder: Path | None) -> Path:
    name = f"{source.stem}.derived.mcap"
    if folder is None:
        return Path(name)
    return folder / source.below_pattern.with_name(name) if isinstance(source, LogUrl) else folder / name


def check_source(paths: Sequence[LogLocation], derived: Path) -> None:
    """Check that a derived log has results of these logs: its runs name their inputs by content.

    The largest input decides, such as the markers: two logs of a lab can have equal rigs and intrinsics.
    """
    with Session([derived]) as results, Session(paths) as session:
        inputs = [read for run in results.runs() for read in run.inputs]
        known = [read for read in inputs if session.count(read.topic)]
        largest = max(known, key=lambda read: read.messages, default=None)
        if inputs and (largest is None or session.hash(largest.topic) != largest.hash):
            raise IpsysError(
                f"{derived}: has results of another log than {session}; move it, or choose another name or "
                "folder for the results"
            )


@contextmanager
def open_target(
    paths: Sequence[LogLocation], output: Path | None
) -> Iterator[tuple[list[LogLocation], Path]]:
    """Yield the logs to read, and the log to append to: the last log of ``paths``, or a new log.

    A new log gets its name only when all work is done. If there was no work, or after an error, no new log
    remains.
    """
    if output is None:
        if not isinstance(paths[-1], Path):
            raise IpsysError(
                f"{paths[-1]}: nothing can be appended to a log at a URL; give a new log with -o"
            )
        yield list(paths), paths[-1]
        return
    _check_free(output)
    # Another process may write a log of that name at the same time: the first one to finish gets the name.
    partial = partial_of(output)
    with ExitStack() as stack:
        for path in (partial, journal_path(partial)):
            path.unlink(missing_ok=True)  # of an earlier process with this number
            stack.callback(path.unlink, missing_ok=True)
        LogWriter.create(partial).close()
        yield [*paths, partial], partial
        with LogReader(partial) as log:
            anything = log.message_count > 0
        if anything:
            _give_name(partial, output)


def _give_name(partial: Path, output: Path) -> None:
    """Rename a file; do not overwrite a file that another process has created in the meantime."""
    try:
        os.link(partial, output)
    except FileExistsError:
        _check_free(output)
        raise
    except OSError:  # a filesystem without hard links
        _check_free(output)
        partial.rename(output)
    with suppress(OSError):  # the file has its name, and all its data are safe
        DISK.fsync_directory(output.parent)


def _check_free(output: Path) -> None:
    if (text := describe_broken_link(output)) is not None:
        raise IpsysError(text)
    if output.exists():
        raise IpsysError(
            f"{output}: exists already; choose another name, or give it as an input to extend it"
        )
