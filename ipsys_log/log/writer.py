"""A writer for new logs, and for appends to finished logs."""

import os
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Self

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, disk_advice
from ipsys_log.log.byte_source import LARGEST_MESSAGE, FileBytes
from ipsys_log.log.contents import Contents, Schema, free_id
from ipsys_log.log.hashing import METADATA_NAME, Buffer, ChannelHash, metadata_of_hashes, stored_hashes
from ipsys_log.log.journal import DISK, Storage, check_free, open_locked, roll_back
from ipsys_log.log.known_contents import contents_of, note_contents
from ipsys_log.log.output import (
    IMAGE_SCHEMAS,
    IMAGES,
    SMALL_APPENDED,
    SMALL_LIVE,
    ChunkBuilder,
    ChunkLimits,
    NewFile,
    Output,
    PendingAppend,
    cannot_write,
)
from ipsys_log.log.records import HEADER, MAGIC, MESSAGE, ChunkRef, to_bytes
from ipsys_log.log.summary import tail_bytes, temporary_tail_bytes

LIBRARY = "ipsys 1"  # fixed, so that the same messages give the same bytes


class LogWriter:
    """A writer of messages into a new log (`create`) or at the end of a finished log (`append`).

    Image channels go into uncompressed chunks of about 4 MiB, all others into compressed chunks of
    their own. The same calls give the same bytes. Use it as a context manager.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from ipsys_log.log.reader import LogReader
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.mcap"
    ...     with LogWriter.create(path) as log:
    ...         log.add_channel("/a", Schema("A", "jsonschema", b"{}"), "json")
    ...         log.write("/a", 1_000, 900, b"{}")
    ...     with LogWriter.append(path) as log:
    ...         log.add_channel("/runs/poly/b", Schema("B", "jsonschema", b"{}"), "json")
    ...         log.write("/runs/poly/b", 1_000, 900, b"{}")
    ...     with LogReader(path) as reader:
    ...         sorted(reader.channels)
    ['/a', '/runs/poly/b']
    """

    def __init__(
        self,
        path: Path,
        output: Output,
        contents: Contents,
        limits: ChunkLimits,
        hashes: Mapping[str, ChannelHash] | None = None,
    ) -> None:
        self.path = path
        self._output = output
        self._contents = contents
        self._images = ChunkBuilder(IMAGES, compress=False)
        self._small = ChunkBuilder(limits, compress=True)
        self._channels: dict[str, tuple[int, ChunkBuilder]] = {}
        # The last declaration of each topic: a search of all channels for each message takes too long.
        self._declared: dict[str, tuple[Schema | None, str]] = {}
        # A live run grows for days. Until its end, only its summary needs these.
        self._packed_chunks: list[bytes] = []
        self._hashes: dict[str, ChannelHash] = dict(hashes or {})
        self._stored: dict[str, ChannelHash] = {}
        self._open = True

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        atomic: bool = False,
        overwrite: bool = False,
        storage: Storage = DISK,
    ) -> Self:
        """Create a new log.

        Parameters
        ----------
        path
            A file that does not exist yet, except with `overwrite`.
        atomic
            False: the file grows in place, so that the data of a killed recorder stay there. An exception in
            the with-block finishes the log with its messages so far. True: the log is written as
            ``<path>.partial`` and renamed when it is complete; an exception leaves no file.
        overwrite
            With `atomic`: replace an existing log in the moment when the new one is complete.
        storage
            The operations on files; only tests replace them.

        Raises
        ------
        LogError
            `path` exists, its folder does not, or another process is writing it.
        """
        target = Path(path)
        if overwrite and atomic and target.is_file():
            _settle_old(storage, target)
        else:
            check_free(target)
        file = target.with_name(target.name + ".partial") if atomic else target
        fd = open_locked(storage, file, os.O_RDWR | os.O_CREAT | (0 if atomic else os.O_EXCL))
        output = NewFile(storage, file, fd, target if atomic else None, overwrite)
        try:
            if atomic:
                storage.truncate(fd, 0)  # an earlier writer of this file was killed: remove its data
            storage.fsync_directory(file.parent)
            output.emit(MAGIC + to_bytes(mcap.Header("", LIBRARY)))
        except BaseException as error:
            with suppress(OSError):  # the file has no messages
                storage.unlink(file)
            output.close()
            if isinstance(error, OSError):
                outcome = f"nothing was written: {disk_advice(error)}"
                raise cannot_write(target, error, outcome) from None
            raise
        return cls(target, output, Contents(), SMALL_LIVE)

    @classmethod
    def append(cls, path: str | os.PathLike[str], *, storage: Storage = DISK) -> Self:
        """Continue a finished log in place.

        The writer keeps the exclusive lock until `close`. The file is not changed before that. An exception
        in the with-block leaves it unchanged. A crash at any instant leaves the old log or the new one.

        Raises
        ------
        LogError
            The log is damaged or has no footer, or another process is writing it.
        """
        target = Path(path)
        fd = open_locked(storage, target, os.O_RDWR)
        try:
            roll_back(storage, target, fd)
            size = os.fstat(fd).st_size
            view = FileBytes(target, fd, size, size)
            contents = contents_of(view)
            stored = stored_hashes(view, contents)
        except BaseException:
            storage.close(fd)
            raise
        crc = contents.data_crc or None
        make_temporary_tail = partial(temporary_tail_bytes, contents.copy())
        output = PendingAppend(
            storage, target, fd, size, contents.data_end, contents.data_end, crc, make_temporary_tail
        )
        writer = cls(target, output, contents, SMALL_APPENDED)
        writer._stored = stored
        return writer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        output = self._output
        if kind is None or (isinstance(output, NewFile) and output.target is None):
            self.close()
        else:
            self.abandon()

    def move(self, path: Path) -> None:
        """Rename a new log, and replace an existing file in one step; later writes go to the new name."""
        output = self._output
        if not isinstance(output, NewFile):
            raise ValueError(f"{self.path}: an append stays where it is")
        output.storage.rename(self.path, path)
        self.path = output.path = path
        # The rename is done. After a power cut the name may belong to the old log again.
        with suppress(OSError):
            output.storage.fsync_directory(path.parent)

    @property
    def fd(self) -> int:
        """The descriptor of the file until it is closed."""
        return self._output.fd

    def add_channel(self, topic: str, schema: Schema | None, message_encoding: str = "protobuf") -> None:
        """Declare a channel; a second call with the same schema does nothing.

        An append continues a channel of the log with the same topic and schema. If the schema now has more
        fields, the append adds a second channel for the topic. Readers read both as one channel.

        Raises
        ------
        LogError
            The log has this topic with a schema of another name, or another encoding.
        """
        self._check_open()
        if self._declared.get(topic) == (schema, message_encoding):
            return
        self._check_kind(topic, schema, message_encoding)
        schema_id = self._schema_id(schema) if schema else 0
        for channel in self._contents.channels.values():
            if (channel.topic, channel.schema_id) == (topic, schema_id):
                break
        else:
            channel_id = self._free_id(self._contents.channels)
            channel = mcap.Channel(channel_id, topic, message_encoding, {}, schema_id)
            self._output.emit(to_bytes(channel))
            self._contents.channels[channel.id] = channel
        self._select(topic, channel.id, schema)
        self._declared[topic] = schema, message_encoding

    def adopt_channel(self, channel: mcap.Channel, schema: mcap.Schema | None) -> int:
        """Declare a channel of another log; return its id here, which is the same if this id is free.

        A channel with the same topic, schema and metadata is continued.
        """
        self._check_open()
        own = Schema(schema.name, schema.encoding, schema.data) if schema else None
        self._check_kind(channel.topic, own, channel.message_encoding)
        known = (c for c in self._contents.channels.values() if c.topic == channel.topic)
        same = next((c for c in known if self._schema_of(c) == own and c.metadata == channel.metadata), None)
        if same is None:
            schema_id = self._schema_id(own, schema.id) if own and schema else 0
            key = self._free_id(self._contents.channels, channel.id)
            metadata = dict(channel.metadata)
            same = mcap.Channel(key, channel.topic, channel.message_encoding, metadata, schema_id)
            self._output.emit(to_bytes(same))
            self._contents.channels[same.id] = same
        self._select(channel.topic, same.id, own)
        return same.id

    def define(self, record: mcap.Schema | mcap.Channel) -> None:
        """Write a definition of a damaged log as it is; its id must be free here."""
        if isinstance(record, mcap.Schema):
            self._contents.schemas[record.id] = record
        else:
            self._check_kind(record.topic, self._schema_of(record), record.message_encoding)
            self._contents.channels[record.id] = record
        self._output.emit(to_bytes(record))

    def defines(self, record: mcap.Schema | mcap.Channel) -> bool:
        """Return whether the log has exactly this definition."""
        if isinstance(record, mcap.Schema):
            return self._contents.schemas.get(record.id) == record
        return self._contents.channels.get(record.id) == record

    def has_channel(self, channel_id: int) -> bool:
        return channel_id in self._contents.channels

    def use(self, channel_id: int) -> str:
        """Write the next messages of a topic to this one of its channels; return the topic."""
        channel = self._contents.channels[channel_id]
        self._select(channel.topic, channel_id, self._schema_of(channel))
        return channel.topic

    def _select(self, topic: str, channel_id: int, schema: Schema | None) -> None:
        """Write the next messages of a topic to a channel, in a chunk of images or of other messages."""
        is_image = schema is not None and schema.name in IMAGE_SCHEMAS
        self._channels[topic] = channel_id, self._images if is_image else self._small
        self._declared.pop(topic, None)

    def copy_chunk(
        self,
        chunk: ChunkRef,
        data: Buffer,
        crc: int,
        counts: Mapping[int, int],
        rows: Iterable[tuple[str, int, int, int, int]],
    ) -> None:
        """Copy a chunk of another log, whose channels have the same ids here.

        Parameters
        ----------
        chunk
            Its index in the other log.
        data, crc
            The bytes of the chunk with its message indexes, and their CRC-32.
        counts
            The number of messages by channel id.
        rows
            Each message in the order of the file: topic, log time and publish time in ns, and the length in
            bytes and CRC-32 of its data.
        """
        self.flush()
        shift = self._output.offset - chunk.offset
        self._output.emit(data, crc)
        offsets = {key: offset + shift for key, offset in chunk.index_offsets.items()}
        copy = chunk._replace(offset=chunk.offset + shift, index_offsets=offsets)
        self._packed_chunks.append(copy.pack())
        self._contents.cover(chunk.start_ns, chunk.end_ns)
        for key, number in counts.items():
            self._contents.count(key, number)
        for topic, *row in rows:
            self._hashes.setdefault(topic, ChannelHash()).add_row(*row)

    def copy_record(self, index: mcap.AttachmentIndex | mcap.MetadataIndex, pieces: Iterable[bytes]) -> None:
        """Copy an attachment or a metadata record of another log, in pieces of bytes."""
        self._check_open()
        moved = replace(index, offset=self._output.offset)
        for piece in pieces:
            self._output.emit(piece)
        if isinstance(moved, mcap.AttachmentIndex):
            self._contents.attachments.append(moved)
            self._contents.attachment_count += 1
        else:
            self._contents.metadata.append(moved)
            self._contents.metadata_count += 1

    def hash_of(self, topic: str) -> ChannelHash:
        """Return the hash of the messages that this writer has written to a channel."""
        return self._hashes.get(topic, ChannelHash())

    def write(self, topic: str, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Add a message to a channel that was declared with `add_channel`; times in ns.

        Raises
        ------
        LogError
            The disk refuses the write, or the message is too large for a chunk. The log continues without
            this message.
        """
        self._check_open()
        if len(data) > LARGEST_MESSAGE:
            raise LogError(
                f"{self.path}: a message on {topic} has {len(data)} bytes, more than the {LARGEST_MESSAGE} "
                "that a log may hold: record smaller images"
            )
        channel, builder = self._channels[topic]
        if self._small.is_full(log_time_ns):
            self.flush()  # so a result is never in the file before its frame
        elif self._images.is_full(log_time_ns):
            self._write_chunk(self._images)
        state = self._hashes.get(topic)
        if state is None:
            state = self._hashes[topic] = self._hash_so_far(topic)
        crc = zlib.crc32(data)
        state.add_row(log_time_ns, publish_time_ns, len(data), crc)
        sequence = state.count & 0xFFFFFFFF
        if self._contents.unchunked:
            self._write_unchunked(channel, sequence, log_time_ns, publish_time_ns, data)
        else:
            builder.add(channel, sequence, log_time_ns, publish_time_ns, data, crc)

    def flush(self) -> None:
        """Write the buffered messages as complete chunks; a recorder calls this at least every second."""
        self._check_open()
        for builder in (self._images, self._small):
            self._write_chunk(builder)

    def sync(self) -> None:
        """Wait until the written data of a new log are on the disk; any thread may call this."""
        if isinstance(self._output, NewFile):
            self._output.sync()

    def close(self) -> None:
        """Finish the log: summary, footer, fsync. A second call does nothing."""
        if not self._open:
            return
        try:
            self.flush()
            self._finish()
        except BaseException:
            self._output.abandon()
            raise
        finally:
            self._open = False
            self._output.close()

    def abandon(self) -> None:
        """Discard the writes: an append leaves the log unchanged, an atomic new log leaves no file."""
        if self._open:
            self._open = False
            self._output.abandon()
            self._output.close()

    def _finish(self) -> None:
        contents, output = self._contents, self._output
        contents.chunks += map(ChunkRef.unpack, self._packed_chunks)
        hashes = metadata_of_hashes(self._hashes, output.offset)
        if hashes:
            contents.metadata.append(mcap.MetadataIndex(output.offset, len(hashes), METADATA_NAME))
            contents.metadata_count += 1
            output.emit(hashes)
        contents.data_end, contents.data_crc = output.offset, output.crc or 0
        output.finish(tail_bytes(contents))
        note_contents(output.fd, contents)

    def _check_open(self) -> None:
        if not self._open:
            raise ValueError(f"{self.path}: the log is closed")

    def _check_kind(self, topic: str, schema: Schema | None, message_encoding: str) -> None:
        kind = (schema.name, schema.encoding) if schema else None
        for channel in self._contents.channels.values():
            known = self._contents.schemas.get(channel.schema_id)
            known_kind = (known.name, known.encoding) if known else None
            if channel.topic == topic and (known_kind, channel.message_encoding) != (kind, message_encoding):
                raise LogError(
                    f"{self.path} has {topic} with another schema: use another topic (--run) or file (-o)"
                )

    def _schema_of(self, channel: mcap.Channel) -> Schema | None:
        record = self._contents.schemas.get(channel.schema_id)
        return Schema(record.name, record.encoding, record.data) if record else None

    def _schema_id(self, schema: Schema, wanted: int | None = None) -> int:
        for key, known in self._contents.schemas.items():
            if (known.name, known.encoding, known.data) == (schema.name, schema.encoding, schema.data):
                return key
        key = self._free_id(self._contents.schemas, wanted)
        record = mcap.Schema(key, schema.data, schema.encoding, schema.name)
        self._output.emit(to_bytes(record))
        self._contents.schemas[key] = record
        return key

    def _free_id(self, known: Mapping[int, object], wanted: int | None = None) -> int:
        if wanted is not None and wanted not in known:
            return wanted
        key = free_id(known)
        if key is None:
            raise LogError(f"{self.path} has no free channel or schema id left: write to another file (-o)")
        return key

    def _hash_so_far(self, topic: str) -> ChannelHash:
        ids = [key for key, channel in self._contents.channels.items() if channel.topic == topic]
        count = sum(self._contents.counts.get(key, 0) for key in ids)
        stored = self._stored.get(topic, ChannelHash())
        return stored if stored.count == count else ChannelHash(count, valid=False)

    def _write_chunk(self, builder: ChunkBuilder) -> None:
        chunk = builder.build(self._output.offset)
        if chunk is None:
            return
        ref, data, crc = chunk
        self._output.emit(data, crc)
        self._packed_chunks.append(ref.pack())
        self._contents.cover(ref.start_ns, ref.end_ns)
        for channel, number in builder.counts.items():
            self._contents.count(channel, number)
        builder.clear()

    def _write_unchunked(
        self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes
    ) -> None:
        # The old messages lie in no chunk. Chunk indexes only for new messages would hide the old messages.
        length = MESSAGE.size - HEADER.size + len(data)
        head = MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, log_ns, publish_ns)
        self._output.emit(head + data)
        self._contents.count(channel, 1)
        self._contents.cover(log_ns, log_ns)


def _settle_old(storage: Storage, path: Path) -> None:
    """Check that no process writes a log that is to be replaced, and remove the journal of an append."""
    fd = open_locked(storage, path, os.O_RDWR)
    try:
        roll_back(storage, path, fd)
    finally:
        storage.close(fd)
