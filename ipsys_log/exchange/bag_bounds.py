"""Limits on the decompression of ROS bags: a bag of a few kB must not fill the memory or the disk.

The library decompresses whole chunks, files and messages, without a limit. The limits here are those of logs.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import lz4.frame
import zstandard
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from ipsys_log.errors import IpsysError
from ipsys_log.log.bounds import ReadLimits, chunk_excess
from ipsys_log.log.chunks import unpack
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import parse_chunk_head
from ipsys_log.units import format_bytes

_PIECE = 1 << 20  # bytes
_MCAP = ".mcap"


def bound_reader(path: Path, reader: Reader1 | Reader2) -> bool:
    """Bound the decompression of an open bag; return whether its messages are to be unpacked one by one.

    Raises
    ------
    IpsysError
        A chunk holds more than its limit.
    """
    if isinstance(reader, Reader1):
        limits = ReadLimits(path.stat().st_size)
        for position, chunk in reader.chunks.items():
            if chunk.decompressor in _STREAMS:
                unpacked = partial(_unpack, path, limits, position, _STREAMS[chunk.decompressor])
                reader.chunks[position] = chunk._replace(decompressor=unpacked)
        return False
    storage = reader.storage
    if storage.metadata.compression_mode != "message":
        return False
    storage.metadata = storage.metadata._replace(compression_mode=None)  # the library must not unpack them
    return True


def check_files(path: Path) -> None:
    """Check the size of the files of a ROS 2 bag after their decompression, before the library opens them.

    Raises
    ------
    IpsysError
        A file holds more than its limit, or is compressed twice.
    LogError
        A file of MCAP is damaged.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        if file.suffix == ".zstd":
            if file.stem.endswith(_MCAP):
                raise IpsysError(
                    f"{file}: is compressed as a whole; unpack it with zstd -d, and remove the compression "
                    "from metadata.yaml"
                )
            _count(file)
        elif file.suffix == _MCAP:
            with LogReader(file) as log:
                for chunk in log.contents.chunks:
                    if chunk.compression:
                        unpack(log.view, chunk.offset, parse_chunk_head(log.view, chunk.offset)[1])


def unpack_message(path: Path, data: bytes) -> bytes:
    """Return a message of a bag whose messages are compressed one by one.

    Raises
    ------
    IpsysError
        The message holds more than its limit.
    """
    return _unpack(path, ReadLimits(path.stat().st_size + len(data)), 0, _zstd_pieces, data)


def _count(file: Path) -> None:
    """Refuse a file that unpacks to more than a log of its size may hold."""
    most, size = ReadLimits(file.stat().st_size).max_unpacked, 0
    with file.open("rb") as packed, zstandard.ZstdDecompressor().stream_reader(packed) as reader:
        while piece := reader.read(_PIECE):
            size += len(piece)
            if size > most:
                raise IpsysError(f"{file}: is refused: it unpacks to more than {format_bytes(most)}")


def _unpack(
    path: Path,
    limits: ReadLimits,
    position: int,
    pieces_of: Callable[[bytes], Iterator[bytes]],
    data: bytes,
) -> bytes:
    pieces: list[bytes] = []
    size = 0
    for piece in pieces_of(data):
        pieces.append(piece)
        size += len(piece)
        if excess := chunk_excess(len(data), size) or limits.unpack(position, size):
            raise IpsysError(f"{path}: is refused: {excess.replace('claims to hold', 'holds')}")
    return b"".join(pieces)


def _bz2_pieces(data: bytes) -> Iterator[bytes]:
    stream = bz2.BZ2Decompressor()
    yield stream.decompress(data, _PIECE)
    while not stream.eof and not stream.needs_input:
        yield stream.decompress(b"", _PIECE)
    _check_end(stream.eof)


def _lz4_pieces(data: bytes) -> Iterator[bytes]:
    stream = lz4.frame.LZ4FrameDecompressor()
    yield stream.decompress(data, _PIECE)
    while not stream.eof and not stream.needs_input:
        yield stream.decompress(b"", _PIECE)
    _check_end(stream.eof)


def _zstd_pieces(data: bytes) -> Iterator[bytes]:
    with zstandard.ZstdDecompressor().stream_reader(data) as reader:
        while piece := reader.read(_PIECE):
            yield piece


def _check_end(is_complete: bool) -> None:
    if not is_complete:
        raise EOFError("a compressed chunk is cut off")


# The functions by which the library unpacks chunks of ROS 1, each with one that can stop.
_STREAMS = {bz2.decompress: _bz2_pieces, lz4.frame.decompress: _lz4_pieces}
