"""Damaged ranges of a data section, and the records that replace them in a repair."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.log.damage.resync import PRIVATE
from ipsys_log.log.records import HEADER, MAGIC, to_bytes

_SHORTEST_DEFINITION = 23  # bytes: a schema without name and encoding
_FILLER = Opcode.CHUNK | PRIVATE


@dataclass(slots=True)
class DamagedRange:
    """A byte range from `offset` on that does not consist of whole records.

    A repair replaces it by `head` (the beginning of a file), the message indexes of the chunk before it
    (`entries`), and lost `definitions`. A record of a private type fills the rest; every reader skips this
    record. Only the first bytes of this record are written; its other bytes are not changed.
    """

    offset: int
    length: int
    head: bytes = b""
    chunk: int | None = None  # number of the chunk of `entries`
    entries: Mapping[int, list[tuple[int, int]]] = field(default_factory=dict)
    definitions: list[bytes] = field(default_factory=list)
    _taken: int = 0  # bytes: total size of the replacements above

    @property
    def end(self) -> int:
        return self.offset + self.length

    def indexes(self) -> tuple[bytes, dict[int, int]]:
        """Return the message indexes to be written and their offsets; none if there is no room for them."""
        start = self.offset + len(self.head)
        data, offsets = index_records(self.entries, start)
        rest = self.end - start - len(data)
        return (data, offsets) if rest == 0 or rest >= HEADER.size else (b"", {})

    @property
    def is_full(self) -> bool:
        """Return whether the range has no room for the shortest definition."""
        return self.length - self._taken < _SHORTEST_DEFINITION

    def define(self, definitions: bytes) -> bool:
        """Add these records if there is room for them."""
        if self._taken == 0:
            self._taken = len(self.head) + len(self.indexes()[0])
        if self._taken + len(definitions) > self.length:
            return False
        self._taken += len(definitions)
        self.definitions.append(definitions)
        return True

    def content(self) -> bytes:
        """Return the new bytes at `offset`: all of the range, or its beginning."""
        data = b"".join((self.head, self.indexes()[0], *self.definitions))
        rest = self.length - len(data)
        if 0 < rest < HEADER.size:  # too small for a separate record
            return _padded(data, len(MAGIC) if self.offset == 0 else 0, rest)
        return data + (HEADER.pack(_FILLER, rest - HEADER.size) if rest else b"")


def _padded(data: bytes, start: int, rest: int) -> bytes:
    """Pad the last record with zeros: readers skip bytes after the fields that they know."""
    last = start
    while start < len(data):
        last, start = start, start + HEADER.size + HEADER.unpack_from(data, start)[1]
    opcode, length = HEADER.unpack_from(data, last)
    return data[:last] + HEADER.pack(opcode, length + rest) + data[last + HEADER.size :] + bytes(rest)


def index_records(entries: Mapping[int, list[tuple[int, int]]], offset: int) -> tuple[bytes, dict[int, int]]:
    """Return the MessageIndex records of a chunk for `offset`, and the offset of each by channel id."""
    pieces: list[bytes] = []
    offsets: dict[int, int] = {}
    for channel, rows in entries.items():
        pieces.append(to_bytes(mcap.MessageIndex(channel, rows)))
        offsets[channel], offset = offset, offset + len(pieces[-1])
    return b"".join(pieces), offsets
