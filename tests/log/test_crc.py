"""A CRC combined from the parts equals that of the whole."""

import zlib
from random import Random

from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.log.hashing import WORTH_COMBINING, combine, extend

CRCS = st.integers(0, (1 << 32) - 1)


@given(st.binary(), st.binary())
def test_crc_of_two_texts_is_combined(first: bytes, second: bytes) -> None:
    assert combine(zlib.crc32(first), zlib.crc32(second), len(second)) == zlib.crc32(first + second)


@given(CRCS, st.integers(0, 1 << 20), st.binary(max_size=20))
def test_crc_of_zeros_is_combined_for_any_length(crc: int, zeros: int, rest: bytes) -> None:
    text = bytes(zeros) + rest
    assert combine(crc, zlib.crc32(text), len(text)) == zlib.crc32(text, crc)


@given(CRCS, CRCS, CRCS, st.integers(0, 1 << 60), st.integers(0, 1 << 60))
def test_texts_longer_than_memory_are_refused(
    first: int, second: int, third: int, one: int, other: int
) -> None:
    """The order of combination does not matter."""
    from_left = combine(combine(first, second, one), third, other)
    assert from_left == combine(first, combine(second, third, other), one + other)


@given(CRCS, st.integers(-3, 3), st.integers(0, 99))
def test_either_way_gives_the_same(crc: int, more: int, seed: int) -> None:
    data = Random(seed).randbytes(WORTH_COMBINING + more)
    for piece in (data, memoryview(data)):
        assert extend(crc, piece, zlib.crc32(data)) == zlib.crc32(data, crc)
