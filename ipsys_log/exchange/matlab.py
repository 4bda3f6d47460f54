"""Tables of numbers in a MATLAB file (version 5).

SciPy's reader trusts the types and flags in a file: wrong ones crash the process.
Layout: "MAT-File Format", The MathWorks, chapter 1.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError

__all__ = ["read_mat"]

_HEAD = 128  # bytes
_LITTLE_ENDIAN = b"\x00\x01IM"
_TAG = struct.Struct("<II")  # type, bytes that follow
_MATRIX, _COMPRESSED, _FLAGS, _DIMENSIONS, _TEXT = 14, 15, 6, 5, 1
_NUMBERS = {
    1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8",
}  # fmt: skip
_CLASSES = range(6, 16)  # double to uint64; no cells, structures, objects or functions
_LARGEST = 16 << 20  # bytes of one table


def read_mat(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read the tables of a MATLAB file by name, each of two dimensions.

    Raises
    ------
    IpsysError
        The file cannot be read, has another version, or holds other data than tables of real numbers.
    """
    try:
        data = path.read_bytes()
        if data[124:_HEAD] != _LITTLE_ENDIAN:
            raise ValueError("no header of version 5")
        return dict(map(_table, _matrices(data)))
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, struct.error, zlib.error) as error:
        raise IpsysError(f"{path}: is not a MATLAB file that can be read: {error}") from error


def _matrices(data: bytes) -> Iterator[bytes]:
    at = _HEAD
    while at < len(data):
        kind, size = _TAG.unpack_from(data, at)
        body = data[at + _TAG.size : at + _TAG.size + size]
        at += _TAG.size + size
        if len(body) < size:
            raise ValueError("it is cut off")
        if kind == _COMPRESSED:
            whole = zlib.decompressobj().decompress(body, _LARGEST)
            kind, size = _TAG.unpack_from(whole)
            body = whole[_TAG.size :]
        if kind != _MATRIX or len(body) != size:
            raise ValueError("it holds data other than tables")
        yield body


def _table(matrix: bytes) -> tuple[str, NDArray[np.float64]]:
    """Parse flags, dimensions, name and numbers: each has a tag and is padded to 8 bytes."""
    parts = list(_parts(matrix))
    if [kind for kind, _ in parts[:-1]] != [_FLAGS, _DIMENSIONS, _TEXT] or parts[-1][0] not in _NUMBERS:
        raise ValueError("a table lacks some of its parts")
    (_, flags), (_, sizes), (_, name), (kind, numbers) = parts
    if len(flags) != 8 or flags[0] not in _CLASSES or flags[1]:
        raise ValueError("it holds data other than real numbers")
    rows, columns = struct.unpack("<ii", sizes)
    values = np.frombuffer(numbers, _NUMBERS[kind])
    if min(rows, columns) < 0 or rows * columns != len(values):
        raise ValueError("the size of a table does not match its numbers")
    return name.decode(), values.astype(np.float64).reshape((rows, columns), order="F")


def _parts(matrix: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(matrix):
        kind, size = _TAG.unpack_from(matrix, at)
        start, step = at + _TAG.size, _TAG.size + -(-size // 8) * 8
        if kind >> 16:  # up to four bytes lie in the tag
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, _TAG.size
        if start + size > len(matrix) or (step == _TAG.size and size > 4):
            raise ValueError("a part of a table is cut off")
        yield kind, matrix[start : start + size]
        at += step
