"""The size of a picture from the first bytes of its file, without decoding it."""

from __future__ import annotations

import struct
from pathlib import Path

import simplejpeg

__all__ = ["read_picture_size"]

# An embedded thumbnail may come before the size of a JPEG.
_FIRST_BYTES = 1 << 18
_PNG = b"\x89PNG\r\n\x1a\n"


def read_picture_size(path: Path) -> tuple[int, int] | None:
    """Return width and height in px from the header of a JPEG or PNG file.

    None for another kind of file, or for an unreadable header.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_FIRST_BYTES)
    except OSError:
        return None
    if data.startswith(_PNG) and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return int(width), int(height)
    if not data.startswith(b"\xff\xd8"):
        return None
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except (ValueError, KeyError):  # KeyError: it found no colour space
        return None
    return int(width), int(height)
