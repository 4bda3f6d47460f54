"""Times within messages are shifted: all other fields stay, and damage is reported."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.errors import LogError
from ipsys_log.log.codec import decode, encode
from ipsys_log.log.contents import Schema, StoredChannel
from ipsys_log.log.merged_logs import check_shift, shift_time, shift_times
from ipsys_log.messages import CompressedImage

IMAGE = "foxglove.CompressedImage"
S = 1_000_000_000
# Fields of a newer version, with tags of two bytes: a number, eight bytes, four bytes, and a text.
NEWER = [
    b"\xd0\x05\x96\x01",
    b"\xd1\x05" + bytes(range(8)),
    b"\xd5\x05" + bytes(range(4)),
    b"\xd2\x05\x03abc",
]


def image(time_ns: int) -> bytes:
    return encode(CompressedImage(time_ns, "red", bytes(40_000), "jpeg"))


@given(
    time_ns=st.integers(1, 2**62),
    offset_ns=st.integers(-S, S).filter(bool),
    newer=st.lists(st.sampled_from(NEWER), max_size=3),
)
def test_only_the_time_changes(time_ns: int, offset_ns: int, newer: list[bytes]) -> None:
    data = image(time_ns) + b"".join(newer)
    if time_ns + offset_ns <= 0:
        with pytest.raises(LogError, match="cannot be shifted"):
            shift_times(IMAGE, data, offset_ns)
        return
    shifted = shift_times(IMAGE, data, offset_ns)
    payload = decode(IMAGE, shifted)
    assert payload.timestamp == time_ns + offset_ns
    assert payload.data == bytes(40_000)
    assert shift_times(IMAGE, shifted, -offset_ns) == data


def test_message_without_a_time_stays_as_it_is() -> None:
    assert shift_times(IMAGE, image(0), S) == image(0)
    assert shift_time(0, S) == 0


@pytest.mark.parametrize(
    "damage",
    [b"\xd0\x05" + b"\xff" * 11, b"\xd6\x05", b"\xd2\x05\x7fabc", b"\xd5\x05\x01"],
    ids=["number of eleven bytes", "unknown wire type", "text beyond the end", "four bytes cut off"],
)
def test_damaged_message_is_an_error(damage: bytes) -> None:
    with pytest.raises(LogError, match=f"a message is not a valid {IMAGE}"):
        shift_times(IMAGE, image(S) + damage, S)


def test_known_messages_in_another_encoding_are_refused() -> None:
    schema = Schema(IMAGE, "jsonschema", b"{}")
    channel = StoredChannel("/cameras/red/image", schema, "json", {}, 1)
    with pytest.raises(LogError, match="because their encoding is json; merge it as the first log"):
        check_shift(channel)
    check_shift(StoredChannel("/cameras/red/image", schema, "protobuf", {}, 1))
    check_shift(StoredChannel("/other", None, "json", {}, 1))
