"""Hashes of channels: what a run read, without reading the images again.

A digest is a chain over the messages in log order, so that it does not depend on chunks or files, and
can be continued when a channel grows.
"""

import hashlib
import struct
import zlib
from dataclasses import dataclass

from mcap import records as mcap

from ipsys_log.log.records import as_bytes

__all__ = ["METADATA_NAME", "ChannelHash", "hashes_from_metadata", "metadata_of_hashes"]

METADATA_NAME = "ipsys"
_ROW = struct.Struct("<QQQI")
_PREFIX = "hash:"


@dataclass(slots=True)
class ChannelHash:
    """The chain after `count` messages, the last one at `last_ns`.

    `valid` is False once a message came that is older than the last one: then the chain is not in log
    order, and only reading the channel gives its hash.
    """

    count: int = 0
    last_ns: int = 0
    digest: bytes = bytes(16)
    valid: bool = True

    def add(self, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Continue the chain by one message."""
        self.add_row(log_time_ns, publish_time_ns, len(data), zlib.crc32(data))

    def add_row(self, log_time_ns: int, publish_time_ns: int, length: int, crc: int) -> None:
        """The same for a message of which the length and the CRC-32 are known."""
        if log_time_ns < self.last_ns:
            self.valid = False
        self.count += 1
        self.last_ns = log_time_ns
        if self.valid:
            row = _ROW.pack(log_time_ns, publish_time_ns, length, crc)
            self.digest = hashlib.blake2b(self.digest + row, digest_size=16).digest()


def metadata_of_hashes(hashes: dict[str, ChannelHash], offset: int) -> bytes:
    """The Metadata record that stores the valid ones of `hashes`, by topic, to be written at `offset`.

    It holds its own offset: a tool that copies records to other places changes the log without knowing
    of the hashes, which are then not believed.
    """
    values = {"offset": str(offset)}
    for topic, state in hashes.items():
        if state.valid and state.count:
            values[_PREFIX + topic] = f"{state.count} {state.last_ns} {state.digest.hex()}"
    return as_bytes(mcap.Metadata(METADATA_NAME, values)) if len(values) > 1 else b""


def hashes_from_metadata(record: mcap.Metadata, offset: int) -> dict[str, ChannelHash]:
    """The hashes stored in `record`, which was found at `offset`; none if it was moved or is not ours."""
    found: dict[str, ChannelHash] = {}
    if record.name != METADATA_NAME or record.metadata.get("offset") != str(offset):
        return found
    for key, value in record.metadata.items():
        if key.startswith(_PREFIX):
            try:
                count, last_ns, digest = value.split()
                state = ChannelHash(int(count), int(last_ns), bytes.fromhex(digest))
            except ValueError:
                continue
            if len(state.digest) == 16:
                found[key.removeprefix(_PREFIX)] = state
    return found
