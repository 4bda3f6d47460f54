"""Frames that have waited are late, and missing frames are gaps: the rate counts both right."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.tools.recording import find_gaps
from ipsys_log.units import NS_PER_S

RATE_HZ = 10.0
PASS_S = 0.001  # the time that a recorder needs for a frame that waits


def arrivals_s(count: int, stall_s: tuple[float, float]) -> np.ndarray:
    """Return the arrivals of frames at 10 Hz at a recorder that stalls from one time to another."""
    start_s, end_s = stall_s
    captured_s = np.arange(count) / RATE_HZ
    waiting = (captured_s > start_s) & (captured_s < end_s)
    arrived_s = captured_s.copy()
    arrived_s[waiting] = end_s + PASS_S * np.arange(waiting.sum())
    return np.asarray(np.sort(arrived_s))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(start=st.integers(5, 40), frames=st.integers(1, 40))
def test_frames_that_waited_do_not_raise_the_rate(start: int, frames: int) -> None:
    stall_s = (start + 0.5) / RATE_HZ, (start + 0.5 + frames) / RATE_HZ
    gaps = find_gaps((arrivals_s(102, stall_s) * NS_PER_S).astype(np.int64))
    assert gaps.rate_hz == pytest.approx(RATE_HZ, rel=0.02)
    assert gaps.lengths_s == ()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(start=st.integers(5, 50), frames=st.integers(3, 40))
def test_missing_frames_are_a_gap_outside_of_the_rate(start: int, frames: int) -> None:
    times_s = np.delete(np.arange(102) / RATE_HZ, slice(start, start + frames))
    gaps = find_gaps(np.rint(times_s * NS_PER_S).astype(np.int64))
    assert gaps.rate_hz == pytest.approx(RATE_HZ)
    assert list(gaps.lengths_s) == pytest.approx([(frames + 1) / RATE_HZ])
    assert gaps.starts_ns == (round((start - 1) / RATE_HZ * NS_PER_S),)


def test_gap_is_shorter_by_the_frames_that_waited() -> None:
    arrived_s = arrivals_s(102, (3.05, 7.05))
    times_s = np.delete(arrived_s, slice(31, 51))  # of 40 frames in the stall, 20 are dropped
    gaps = find_gaps((times_s * NS_PER_S).astype(np.int64))
    assert gaps.rate_hz == pytest.approx(RATE_HZ, rel=0.02)
    assert list(gaps.lengths_s) == pytest.approx([2.1], abs=0.1)


def test_simultaneous_frames_have_no_rate() -> None:
    assert find_gaps(np.zeros(4, dtype=np.int64)).rate_hz is None
    assert find_gaps(np.array([5])).rate_hz is None
