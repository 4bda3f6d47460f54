"""Check of the stated size of an encoded picture, before memory is allocated."""

from __future__ import annotations

from ipsys_log.errors import FrameError

__all__ = ["MOST_PIXELS", "check_encoded", "check_size"]

MOST_PIXELS = 1 << 27  # 134 million
# A JPEG has at least one bit for each block of 8 x 8 px.
_JPEG_PIXELS_PER_BYTE = 512
# SOF0 to SOF15, except the tables and the extension between them.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SCAN = 0xDA
_PNG = b"\x89PNG\r\n\x1a\n"


def check_encoded(data: bytes) -> None:
    """Refuse a JPEG or PNG whose header states more pixels than it can have.

    Raises
    ------
    FrameError
        It claims more than `MOST_PIXELS`, or more than its bytes can code.
    """
    if data[:2] == b"\xff\xd8":
        width, height = _jpeg_size(data)
        check_size(width, height, len(data))
    elif data[:8] == _PNG and len(data) >= 24:
        check_size(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))


def check_size(width: int, height: int, jpeg_bytes: int | None = None) -> None:
    """Refuse a size in px that is too large, also for the number of bytes of a JPEG.

    Raises
    ------
    FrameError
        See :func:`check_encoded`.
    """
    if width * height > MOST_PIXELS:
        raise FrameError(f"a picture of {width} x {height} px, more than {MOST_PIXELS} in all")
    if jpeg_bytes is not None and width * height > _JPEG_PIXELS_PER_BYTE * jpeg_bytes:
        raise FrameError(f"{jpeg_bytes} bytes are too few for a JPEG of {width} x {height} px")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Return width and height in the first frame header; (0, 0) if there is none before the pixels."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF and data[at + 1] != _JPEG_SCAN:
        if data[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        if data[at + 1] in _JPEG_FRAMES:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0, 0
