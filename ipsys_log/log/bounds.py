"""Limits on the work to read a log, in proportion to the size of its file.

A compressor stores 1 GB of zeros in 33 kB, and half a million empty messages in about 1 kB. Recorded
logs stay far below every limit. Each byte of their file unpacks to 2 to 4 bytes, and a message takes
170 bytes or more.
"""

from dataclasses import dataclass, field

from ipsys_log.errors import LogError
from ipsys_log.units import format_bytes

_MIB = 1 << 20
LARGEST_CHUNK = 256 * _MIB  # bytes, uncompressed
LARGEST_MESSAGE = LARGEST_CHUNK - 8 * _MIB  # bytes: the rest of the chunk is for earlier messages
LARGEST_DEFINITION = 4 * _MIB  # bytes of a schema, a channel or a metadata record
_ANY_RATIO = 16 * _MIB  # bytes: a chunk up to this size may have any compression ratio
_HIGHEST_RATIO = 200
_UNPACKED = 128 * _MIB  # bytes: the limit for all chunks of a small file together
_RECORDS = 20_000
_BYTES_PER_RECORD = 8
_CHANNELS = 1_000
_BYTES_PER_CHANNEL = 1_000
_ITEMS = 50_000
_BYTES_PER_ITEM = 4


class BoundError(LogError):
    """A log that needs more time or memory than the limit for its file size."""


def chunk_excess(packed: int, unpacked: int) -> str:
    """Return the reason to refuse a chunk of `packed` bytes that unpacks to `unpacked` bytes, else "".

    Examples
    --------
    >>> chunk_excess(33_000, 1 << 30)
    'a chunk of 33.0 kB claims to hold 1.1 GB, more than 268.4 MB'
    >>> chunk_excess(33_000, 3 << 20)
    ''
    """
    claim = f"a chunk of {format_bytes(packed)} claims to hold {format_bytes(unpacked)}, more than"
    if unpacked > LARGEST_CHUNK:
        return f"{claim} {format_bytes(LARGEST_CHUNK)}"
    if unpacked > _ANY_RATIO and unpacked > _HIGHEST_RATIO * packed:
        return f"{claim} {_HIGHEST_RATIO} times its size"
    return ""


@dataclass(slots=True)
class ReadLimits:
    """The limits of the work for a file of `size` bytes. Each chunk counts once, even if it is read again."""

    size: int
    _unpacked: dict[int, int] = field(default_factory=dict)
    _records: dict[int, int] = field(default_factory=dict)
    _total_unpacked: int = 0
    _total_records: int = 0

    @property
    def max_unpacked(self) -> int:
        """The limit for all compressed chunks together, in bytes after decompression."""
        return _UNPACKED + _HIGHEST_RATIO * max(0, self.size - _MIB)

    @property
    def max_records(self) -> int:
        """The limit for the number of records in chunks without a message index."""
        return _RECORDS + self.size // _BYTES_PER_RECORD

    @property
    def max_channels(self) -> int:
        """The limit for the number of channels; also for the number of schemas, and of runs."""
        return _CHANNELS + self.size // _BYTES_PER_CHANNEL

    @property
    def max_payload(self) -> int:
        """The limit for one message in a compressed chunk, in bytes."""
        return _ANY_RATIO + 4 * self.size

    @property
    def max_structured(self) -> int:
        """The limit for one message that is not an image, in bytes.

        The parts of such a message take many times its size in memory.
        """
        return 2 * _MIB + self.size

    @property
    def max_items(self) -> int:
        """The limit for the message parts in one read of the log, such as the markers of a frame."""
        return _ITEMS + self.size // _BYTES_PER_ITEM

    def unpack(self, offset: int, size: int) -> str:
        """Count `size` bytes unpacked from the chunk at `offset`.

        Return an error text if the file exceeds its limit, else "".
        """
        self._total_unpacked += size - self._unpacked.get(offset, 0)
        self._unpacked[offset] = size
        if self._total_unpacked <= self.max_unpacked:
            return ""
        return f"its chunks hold more than {format_bytes(self.max_unpacked)}"

    def records_left(self, offset: int) -> int:
        """Return the number of records that the chunk at `offset` may hold."""
        return self.max_records - self._total_records + self._records.get(offset, 0)

    def count_records(self, offset: int, number: int) -> None:
        """Count the records of the chunk at `offset`."""
        self._total_records += number - self._records.get(offset, 0)
        self._records[offset] = number


@dataclass(slots=True)
class PartCounter:
    """A counter of the message parts that are still allowed, such as the markers of a frame."""

    left: int

    def take(self, number: int) -> None:
        """Count `number` parts.

        Raises
        ------
        BoundError
            `number` is larger than the number of parts left.
        """
        self.left -= number
        if self.left < 0:
            raise BoundError("the messages have more parts than a log of this size may hold")
