"""Ranges of an object in a store: the right bytes, few requests, and a bounded cache."""

import random
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.errors import LogError
from ipsys_log.log.location import LogUrl, parse_location
from ipsys_log.log.remote_bytes import GAP, RemoteBytes, RemoteRanges, join_ranges
from ipsys_log.log.remote_object import RemoteObject

MB = 1 << 20


def held_object(data: bytes) -> RemoteObject:
    """Return an object whose bytes are in memory."""
    return RemoteObject(LogUrl("s3://logs/a.mcap"), None, "", len(data), (), lambda low, high: data[low:high])


DATA = random.Random(1).randbytes(3 * MB)
PLACE = st.tuples(st.integers(0, len(DATA) - 1), st.integers(1, 300_000)).map(
    lambda row: (row[0], min(row[0] + row[1], len(DATA)))
)


@given(st.lists(st.one_of(PLACE, st.lists(PLACE, max_size=5)), max_size=30), st.integers(1, 2 * MB))
def test_reads_with_any_plans_give_the_bytes(steps: list[Any], capacity: int) -> None:
    ranges = RemoteRanges(held_object(DATA), capacity)
    for step in steps:
        if isinstance(step, list):
            ranges.plan("any", step)
            continue
        low, high = step
        assert ranges.read(low, high - low) == DATA[low:high]
        blocks = [(start, start + len(block)) for start, block in ranges._blocks.items()]
        assert sorted(start for start, _ in blocks) == ranges._starts
        assert sum(end - start for start, end in blocks) <= capacity or len(blocks) == 1
        assert len(join_ranges(blocks, gap=-1, longest=0)) == len(blocks)


@given(st.lists(PLACE), st.integers(0, 200_000))
def test_joined_ranges_cover_each_range_once(ranges: list[tuple[int, int]], gap: int) -> None:
    joined = join_ranges(ranges, gap, MB)
    assert joined == sorted(joined)
    assert all(one[1] <= other[0] for one, other in pairwise(joined))
    wanted = {byte for low, high in ranges for byte in (low, (low + high) // 2, high - 1)}
    assert all(any(low <= byte < high for low, high in joined) for byte in wanted)
    assert sum(high - low for low, high in joined) <= sum(high - low + gap for low, high in ranges)


def test_planned_ranges_with_small_gaps_take_one_request() -> None:
    source = held_object(bytes(40 * MB))
    ranges = RemoteRanges(source)
    places = [(20 * MB + number * 10_000, 20 * MB + number * 10_000 + 500) for number in range(100)]
    ranges.plan("chunks", places)
    for low, high in places:
        ranges.read(low, high - low)
    assert (source.requests, source.bytes_fetched) == (1, 99 * 10_000 + 500)


def test_one_read_without_a_plan_fetches_only_its_bytes() -> None:
    source = held_object(bytes(40 * MB))
    ranges = RemoteRanges(source)
    for position in (30 * MB, 10 * MB, 25 * MB):
        ranges.read(position, 8)
    assert (source.requests, source.bytes_fetched) == (3, 24)


def test_reads_in_sequence_are_read_ahead() -> None:
    source = held_object(bytes(40 * MB))
    ranges = RemoteRanges(source)
    for position in range(MB, 33 * MB, 10_000):
        ranges.read(position, 10_000)
    assert source.requests < 15
    assert source.bytes_fetched < 41 * MB


def test_cache_is_bounded_and_a_second_read_is_free() -> None:
    source = held_object(bytes(40 * MB))
    ranges = RemoteRanges(source, capacity=4 * MB)
    for position in range(MB, 30 * MB, MB + GAP + 1):
        ranges.read(position, MB)
    assert sum(map(len, ranges._blocks.values())) <= 4 * MB
    fetched = source.requests
    ranges.read(position, MB)
    assert source.requests == fetched


def test_read_beyond_the_end_is_damage_and_no_request() -> None:
    source = held_object(bytes(1000))
    log = RemoteBytes(LogUrl("s3://logs/a.mcap"), RemoteRanges(source))
    with pytest.raises(LogError, match=r"damaged at byte 990: a record reaches 10 bytes beyond the end"):
        log.read(990, 20)
    assert source.requests == 0


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("s3://lab/2026/a.mcap", "s3://lab/2026/a.mcap"),
        ("https://h/a.mcap?X-Amz-Signature=abc", "https://h/a.mcap"),
        ("ssh://ada:secret@h:22/a.mcap", "ssh://ada:***@h:22/a.mcap"),
    ],
)
def test_url_is_shown_without_its_secrets(text: str, shown: str) -> None:
    location = parse_location(text)
    assert isinstance(location, LogUrl)
    assert (str(location), location.name) == (shown, "a.mcap")
    assert "secret" not in repr(location)
    assert "abc" not in repr(location)


@pytest.mark.parametrize(
    ("text", "is_pattern"),
    [
        ("s3://lab/2026-*/a.mcap", True),
        ("s3://lab/a[12].mcap", True),
        ("https://h/a.mcap?x=*", False),
        ("http://[::1]:80/a.mcap", False),
    ],
)
def test_pattern_is_in_the_path_of_a_url(text: str, is_pattern: bool) -> None:
    assert LogUrl(text).is_pattern is is_pattern
