"""CRCs and shifted times of long messages, compared with those of a complete computation."""

from __future__ import annotations

import zlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.errors import LogError
from ipsys_log.log.checked_chunk import crc_of_changed
from ipsys_log.log.codec import encode, proto_class
from ipsys_log.log.shifted_times import shift_times
from ipsys_log.messages import CompressedImage
from ipsys_log.units import NS_PER_S

IMAGE = "foxglove.CompressedImage"


@given(
    old=st.binary(max_size=300),
    new=st.binary(max_size=300),
    tail=st.integers(0, 100_000),
    changed=st.integers(0, 100_000),
)
def test_crc_of_changed_data_is_that_of_zlib(old: bytes, new: bytes, tail: int, changed: int) -> None:
    """The changed byte is anywhere, also where the data usually stay the same."""
    first, second = old + bytes(tail), bytearray(new + bytes(tail))
    if changed < len(second):
        second[changed] ^= 1
    assert crc_of_changed(first, zlib.crc32(first), bytes(second)) == zlib.crc32(second)


@given(
    time_ns=st.integers(1, 1 << 62),
    offset_ns=st.integers(-(10**12), 10**12),
    frame_id=st.text(max_size=20),
)
def test_long_image_shifts_like_a_parsed_one(time_ns: int, offset_ns: int, frame_id: str) -> None:
    """The other road parses the whole message and serializes it again."""
    data = encode(CompressedImage(time_ns, frame_id, bytes(20_000), "jpeg"))
    if time_ns + offset_ns <= 0:
        with pytest.raises(LogError, match="another offset"):
            shift_times(IMAGE, data, offset_ns)
        return
    proto: Any = proto_class(IMAGE).FromString(data)
    proto.timestamp.seconds, proto.timestamp.nanos = divmod(time_ns + offset_ns, NS_PER_S)
    shifted = shift_times(IMAGE, data, offset_ns)
    assert shifted == proto.SerializeToString(deterministic=True)
    assert shift_times(IMAGE, shifted, -offset_ns) == data


@pytest.mark.parametrize(
    ("tail", "is_valid"),
    [(b"\xfa\x3f\x03abc", True), (b"\x0a\x02\x08\x05", True), (b"\x0a\xff\x7f", False), (b"\x0f", False)],
    ids=["unknown field", "second time", "cut off", "wire type"],
)
def test_long_message_of_another_program_shifts(tail: bytes, is_valid: bool) -> None:
    """Protobuf merges a second copy of a field into the first one."""
    data = encode(CompressedImage(7 * NS_PER_S + 9, "red", bytes(20_000), "jpeg")) + tail
    if not is_valid:
        with pytest.raises(LogError, match="not a valid"):
            shift_times(IMAGE, data, NS_PER_S)
        return
    expected: Any = proto_class(IMAGE).FromString(data)
    expected.timestamp.seconds += 1
    assert proto_class(IMAGE).FromString(shift_times(IMAGE, data, NS_PER_S)) == expected
