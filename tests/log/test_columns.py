"""Columns of messages equal the payloads of the codec for all message contents."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import BoundError, PartCounter
from ipsys_log.log.codec import decode, encode
from ipsys_log.log.columns import read_columns
from ipsys_log.messages import Track, Tracks

FIELDS = ("robot", "id", "x_m", "y_m", "z_m", "heading_rad", "covariance_m2", "cameras", "inside")

finite = st.floats(allow_nan=False, allow_infinity=False)
tracks = st.builds(
    Track,
    robot=st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=6),
    id=st.integers(0, 300),
    x_m=st.sampled_from([0.0, 1.5]) | finite,
    y_m=finite,
    z_m=finite,
    heading_rad=st.none() | st.just(0.0) | finite,
    covariance_m2=st.none() | st.builds(lambda x: x * np.eye(3), finite),
    cameras=st.lists(st.sampled_from(["red", "white", "a"]), max_size=3).map(tuple),
    inside=st.none() | st.booleans(),
)
messages = st.lists(
    st.builds(Tracks, st.integers(0, 2**62), st.lists(tracks, max_size=4).map(tuple)), max_size=12
)


@given(messages)
@settings(max_examples=200)
def test_columns_equal_the_payloads(payloads: list[Tracks]) -> None:
    columns = read_columns("ipsys.v1.Tracks", [encode(one) for one in payloads], FIELDS)
    rows = [(number, track) for number, payload in enumerate(payloads) for track in payload.tracks]
    assert columns.message.tolist() == [number for number, _ in rows]
    for place, (_, track) in enumerate(rows):
        for name in FIELDS:
            column, value = columns.fields[name], getattr(track, name)
            if name == "covariance_m2":
                assert column.missing[place] == (value is None)
                assert value is None or column.values[place].tolist() == value.ravel().tolist()
            elif name == "cameras":
                assert column.values[place] == value
            elif value is None:
                assert column.missing[place]
            else:
                assert not column.missing[place]
                assert column.values[place] == value


def test_messages_of_another_order_of_fields_are_read() -> None:
    track = Track("a", 3, 1.0, 2.0, 3.0)
    data = encode(Tracks(7, (track,)))
    # A writer may repeat a field (the last one counts), and add unknown fields.
    more = data + b"\xb8\x3e\x01"
    columns = read_columns("ipsys.v1.Tracks", [data, more], ("id", "x_m"))
    assert columns.fields["id"].values.tolist() == [3, 3]
    assert columns.fields["x_m"].values.tolist() == [1.0, 1.0]


def test_damaged_message_is_an_error() -> None:
    data = encode(Tracks(7, (Track("a", 3, 1.0, 2.0, 3.0),)))
    with pytest.raises(LogError, match="not a valid"):
        read_columns("ipsys.v1.Tracks", [data[:-3]], ("id",))


def test_more_shapes_than_are_read_together() -> None:
    payloads = [
        Tracks(0, tuple(Track("r" * (1 + (k >> n & 1)), n, 0.5, 0.5, 0.5) for n in range(8)))
        for k in range(200)
    ]
    columns = read_columns("ipsys.v1.Tracks", [encode(one) for one in payloads], ("robot", "id"))
    assert len(columns.message) == 1600
    assert columns.fields["robot"].values.tolist() == [t.robot for one in payloads for t in one.tracks]


@pytest.mark.parametrize("cameras", [("red",), ("red", "white")])
@pytest.mark.parametrize("number", [1, 90])
def test_parts_are_counted_as_the_codec_counts_them(number: int, cameras: tuple[str, ...]) -> None:
    """For messages of one shape, and for more shapes than are read together."""
    track = Track("a", 3, 1.0, 2.0, 3.0, cameras=cameras)
    names = [("a" * n, "b" * (100 - n)) for n in range(1, number + 1)]
    data = [encode(Tracks(7, tuple(replace(track, robot=name) for name in pair))) for pair in names]
    counter, columnar = PartCounter(10_000), PartCounter(10_000)
    for one in data:
        decode("ipsys.v1.Tracks", one, items=counter)
    read_columns("ipsys.v1.Tracks", data, FIELDS, columnar)
    assert columnar == counter
    with pytest.raises(BoundError, match="more parts"):
        read_columns("ipsys.v1.Tracks", data, FIELDS, PartCounter(10_000 - counter.left - 1))
