"""Limits on the work to read a log, in proportion to the size of its file.

A compressor stores a gigabyte of zeros in 33 kB, and half a million empty messages in one. Recorded
logs stay far below every bound: they hold 2 to 4 bytes unpacked for each byte of the file, and a message
takes 170 bytes or more.
"""

from dataclasses import dataclass, field

from ipsys_log.errors import LogError
from ipsys_log.units import format_bytes

__all__ = [
    "LARGEST_CHUNK",
    "LARGEST_DEFINITION",
    "LARGEST_MESSAGE",
    "Allowance",
    "BoundError",
    "Items",
    "chunk_excess",
]

_MIB = 1 << 20
LARGEST_CHUNK = 256 * _MIB  # bytes, uncompressed
LARGEST_MESSAGE = LARGEST_CHUNK - 8 * _MIB  # bytes: leaves room for the earlier messages of its chunk
LARGEST_DEFINITION = 4 * _MIB  # bytes of a schema, a channel or a metadata record
_ANY_RATIO = 16 * _MIB  # bytes: a chunk up to this size may be compressed to any extent
_HIGHEST_RATIO = 200
_UNPACKED = 128 * _MIB  # bytes that the chunks of any file may hold together
_RECORDS = 20_000
_BYTES_PER_RECORD = 8
_CHANNELS = 1_000
_BYTES_PER_CHANNEL = 1_000
_ITEMS = 50_000
_BYTES_PER_ITEM = 4


class BoundError(LogError):
    """A log that needs more time or memory than the limit for its file size."""


def chunk_excess(packed: int, unpacked: int) -> str:
    """Return why a chunk of `packed` bytes that holds `unpacked` bytes is refused, or "" if it is not.

    Examples
    --------
    >>> chunk_excess(33_000, 1 << 30)
    'a chunk of 33.0 kB claims to hold 1.1 GB, more than 268.4 MB'
    >>> chunk_excess(33_000, 3 << 20)
    ''
    """
    what = f"a chunk of {format_bytes(packed)} claims to hold {format_bytes(unpacked)}, more than"
    if unpacked > LARGEST_CHUNK:
        return f"{what} {format_bytes(LARGEST_CHUNK)}"
    if unpacked > _ANY_RATIO and unpacked > _HIGHEST_RATIO * packed:
        return f"{what} {_HIGHEST_RATIO} times its size"
    return ""


@dataclass(slots=True)
class Allowance:
    """The work that a file of `size` bytes may cause. Each chunk counts once, however often it is read."""

    size: int
    _unpacked: dict[int, int] = field(default_factory=dict)
    _records: dict[int, int] = field(default_factory=dict)
    _total_unpacked: int = 0
    _total_records: int = 0

    @property
    def most_unpacked(self) -> int:
        """Bytes that the compressed chunks may hold together."""
        return _UNPACKED + _HIGHEST_RATIO * max(0, self.size - _MIB)

    @property
    def most_records(self) -> int:
        """Records that may lie in chunks without a message index."""
        return _RECORDS + self.size // _BYTES_PER_RECORD

    @property
    def most_channels(self) -> int:
        """Channels, and likewise schemas and runs."""
        return _CHANNELS + self.size // _BYTES_PER_CHANNEL

    @property
    def most_payload(self) -> int:
        """Bytes of one message in a compressed chunk."""
        return _ANY_RATIO + 4 * self.size

    @property
    def most_structured(self) -> int:
        """Bytes of one message that is not an image: its parts take many times its size in memory."""
        return 2 * _MIB + self.size

    @property
    def most_items(self) -> int:
        """Parts of messages, such as the markers of a frame, in one reading of the log."""
        return _ITEMS + self.size // _BYTES_PER_ITEM

    def unpack(self, offset: int, size: int) -> str:
        """Count `size` bytes unpacked from the chunk at `offset`; return why that is too much, or ""."""
        self._total_unpacked += size - self._unpacked.get(offset, 0)
        self._unpacked[offset] = size
        if self._total_unpacked <= self.most_unpacked:
            return ""
        return f"its chunks hold more than {format_bytes(self.most_unpacked)}"

    def records_left(self, offset: int) -> int:
        """Return how many records the chunk at `offset` may hold."""
        return self.most_records - self._total_records + self._records.get(offset, 0)

    def count_records(self, offset: int, number: int) -> None:
        """Count the records of the chunk at `offset`."""
        self._total_records += number - self._records.get(offset, 0)
        self._records[offset] = number


@dataclass(slots=True)
class Items:
    """A counter of the parts of messages that are still allowed, such as the markers of a frame."""

    left: int

    def take(self, number: int) -> None:
        """Count `number` parts.

        Raises
        ------
        BoundError
            More than are left.
        """
        self.left -= number
        if self.left < 0:
            raise BoundError("the messages have more parts than a log of this size may hold")
