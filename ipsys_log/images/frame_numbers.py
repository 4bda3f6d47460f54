"""Whether frames of H.264 are missing, by the numbers that they count themselves with.

FFmpeg fills the place of a frame that was lost with the one before it, and says nothing.

References
----------
ITU-T H.264, 7.3.2.1 (sequence parameter set), 7.3.3 (slice header), 7.4.3 (frame_num).
"""

from __future__ import annotations

import re
from typing import NamedTuple

__all__ = ["FrameNumbers"]

# The head of a unit of Annex B, and as much of it as is read here.
_UNIT = re.compile(rb"\x00\x00\x01(.)(?=(.{0,96}))", re.DOTALL)
_PARAMETERS, _SLICE, _KEY_SLICE = 7, 1, 5
# Profiles whose parameters say more of colour.
_HIGH = (44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244)


class _Counting(NamedTuple):
    """How frames are numbered: with ``bits`` bits; ``planes`` says that each colour has slices of its own."""

    bits: int
    planes: bool


class FrameNumbers:
    """Follows the frames of one camera. Call it with the data of each."""

    def __init__(self) -> None:
        self._counting: _Counting | None = None
        self._last: int | None = None

    def __call__(self, data: bytes) -> bool:
        """Whether one is missing between this frame and the one before; False where that cannot be told."""
        for match in _UNIT.finditer(data):
            head = match[1][0]
            if head & 31 == _PARAMETERS:
                self._counting = _read_counting(_Bits(match[2]))
            elif head & 31 in (_SLICE, _KEY_SLICE):
                return self._counting is not None and self._follow(head, _Bits(match[2]), self._counting)
        return False

    def _follow(self, head: int, bits: _Bits, counting: _Counting) -> bool:
        bits.golomb(), bits.golomb(), bits.golomb()  # where it begins, its type, its parameters
        if counting.planes:
            bits.take(2)
        number, last = bits.take(counting.bits), self._last
        if head >> 5 & 3:  # others need it
            self._last = number
        # Two fields have one number.
        return head & 31 == _SLICE and last is not None and (number - last) % (1 << counting.bits) > 1


class _Bits:
    """The bits of a unit, from its second byte on. Behind its end there are zeros."""

    def __init__(self, data: bytes) -> None:
        plain = data.replace(b"\x00\x00\x03", b"\x00\x00")
        self._text = "".join(f"{byte:08b}" for byte in plain)
        self._at = 0

    def take(self, count: int) -> int:
        self._at += count
        return int(self._text[self._at - count : self._at].ljust(count, "0") or "0", 2)

    def golomb(self) -> int:
        """A number of 2 n + 1 bits, of which the first n are zeros (9.1)."""
        zeros = 0
        while zeros < 32 and not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)


def _read_counting(bits: _Bits) -> _Counting | None:
    """None where numbers may be left out, or a matrix of scales stands before them."""
    profile, planes = bits.take(8), False
    bits.take(16), bits.golomb()
    if profile in _HIGH:
        planes = bits.golomb() == 3 and bool(bits.take(1))
        bits.golomb(), bits.golomb(), bits.take(1)
        if bits.take(1):
            return None
    number_bits = bits.golomb() + 4
    order = bits.golomb()
    if order == 0:
        bits.golomb()
    elif order == 1:
        bits.take(1), bits.golomb(), bits.golomb()
        for _ in range(min(bits.golomb(), 255)):
            bits.golomb()
    bits.golomb()
    return None if bits.take(1) or number_bits > 16 else _Counting(number_bits, planes)
