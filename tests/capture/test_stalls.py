"""A suspended recorder reports the frames with wrong times."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.capture.frames import STALL_NS, Clock, Frame, Heartbeat, LateFrameDetector, Say
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.messages import STAMP_UNRELIABLE, CompressedImage, Event, Message, RigCamera
from ipsys_log.units import NS_PER_S

MS = 1_000_000


class Scripted(Clock):
    """A clock with a settable time."""

    shown_ns = NS_PER_S

    def now_ns(self) -> int:
        return self.shown_ns


def recorded(
    arrivals_ns: Sequence[int], stamped: bool = False, rate_hz: float | None = None
) -> list[Message]:
    """Record a camera whose frames arrive at these times of the clock."""
    clock = Scripted()

    @contextmanager
    def opened(camera: RigCamera, clock_: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            for number, time_ns in enumerate(arrivals_ns):
                clock.shown_ns = time_ns
                yield Frame(b"%d" % number, "jpeg", time_ns if stamped else None)

        yield sent()

    camera = RigCamera("red", source="test:red", rate_hz=rate_hz)
    with LiveCameras([camera], opened, clock) as attached:
        return [message for message in attached if message is not None]


def late_events(messages: Sequence[Message]) -> list[Event]:
    payloads = [message.payload for message in messages]
    return [one for one in payloads if isinstance(one, Event) and one.kind == STAMP_UNRELIABLE]


def paced(start_ns: int, count: int, period_ns: int = 33 * MS) -> list[int]:
    return [start_ns + n * period_ns for n in range(count)]


def test_late_frames_are_between_two_events() -> None:
    before = paced(NS_PER_S, 30)
    stopped_ns, goes_on_ns = before[-1] + 1, before[-1] + 2 * NS_PER_S
    burst = paced(goes_on_ns, 20, 2 * MS)
    after = paced(burst[-1] + 20 * MS, 30)
    messages = recorded([*before, *burst, *after])
    begins, ends = late_events(messages)
    assert (begins.camera, begins.start, begins.end) == ("red", stopped_ns, None)
    assert "was suspended for 2.0 s" in begins.text
    assert ends.start == stopped_ns
    assert ends.end is not None
    assert burst[-1] <= ends.end <= after[6]
    places = {id(m.payload): n for n, m in enumerate(messages)}
    frames = [m.payload for m in messages if isinstance(m.payload, CompressedImage)]
    late = [one for one in frames if places[id(begins)] < places[id(one)] < places[id(ends)]]
    assert [one.timestamp for one in late] == [t for t in (*burst, *after) if t <= ends.end]
    assert [one.timestamp for one in frames] == [*before, *burst, *after]


def test_frames_with_capture_stamps_need_no_event() -> None:
    before = paced(NS_PER_S, 30)
    assert not late_events(recorded([*before, *paced(before[-1] + 2 * NS_PER_S, 30)], stamped=True))


def test_steady_camera_has_no_event() -> None:
    assert not late_events(recorded(paced(NS_PER_S, 200)))


def test_two_stalls_report_the_whole_range() -> None:
    before = paced(NS_PER_S, 30)
    first = paced(before[-1] + NS_PER_S, 10, MS)
    second = paced(first[-1] + NS_PER_S, 10, MS)
    begins, ends = late_events(recorded([*before, *first, *second, *paced(second[-1] + 30 * MS, 20)]))
    assert begins.start == ends.start == before[-1] + 1
    assert ends.end is not None
    assert ends.end > second[-1]


def test_frames_late_at_the_end_have_an_open_range() -> None:
    before = paced(NS_PER_S, 30)
    (begins,) = late_events(recorded([*before, *paced(before[-1] + NS_PER_S, 10, MS)]))
    assert (begins.start, begins.end) == (before[-1] + 1, None)


@settings(max_examples=200)
@given(
    st.floats(5, 60), st.floats(0.3, 5), st.integers(0, 200), st.floats(0.0002, 0.004),
    st.lists(st.floats(-0.15, 0.15), min_size=40, max_size=40),
)  # fmt: skip
def test_every_late_frame_is_named(
    rate_hz: float, stall_s: float, buffered: int, read_s: float, jitter: list[float]
) -> None:
    """A buffer keeps the first frames of the stall, and delivers them at reading speed."""
    period_ns = round(NS_PER_S / rate_hz)
    heartbeat = Heartbeat(Clock())
    late = LateFrameDetector(heartbeat, None)
    captured = [NS_PER_S + n * period_ns for n in range(int(stall_s * rate_hz) + 90)]
    stops_ns = captured[30] + 1
    goes_on_ns = stops_ns + round(stall_s * NS_PER_S)
    missed = [t for t in captured if stops_ns <= t < goes_on_ns][buffered:]
    now_ns = 0
    for number, taken_ns in enumerate(t for t in captured if t not in set(missed)):
        wobbles_ns = round(jitter[number % 40] * period_ns)
        now_ns = max(taken_ns + wobbles_ns + period_ns, now_ns + round(read_s * NS_PER_S))
        if taken_ns + period_ns >= stops_ns:
            now_ns = max(now_ns, goes_on_ns)
        for beat_ns in range(now_ns - period_ns, now_ns, 50 * MS):
            if not stops_ns < beat_ns < goes_on_ns:
                heartbeat.beat(beat_ns)
        late.take(now_ns)
        is_late = now_ns - taken_ns > 1.5 * period_ns + STALL_NS
        assert late.since_ns is not None or not is_late, "a late frame passes for one in time"
        late.has_caught_up()
    assert late.since_ns is None


def test_sleep_of_the_machine_is_in_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    slept_ns = 0
    monkeypatch.setattr("ipsys_log.capture.frames._asleep_ns", lambda: 7 * NS_PER_S + slept_ns)
    clock = Clock()
    stamp_ns, before_ns = time.monotonic_ns(), clock.now_ns()
    slept_ns = 300 * NS_PER_S
    after_ns = clock.now_ns()
    assert 300 * NS_PER_S <= after_ns - before_ns < 310 * NS_PER_S
    # A driver's stamps are from before and after the suspension.
    assert before_ns - 10 * NS_PER_S < clock.to_utc_ns(stamp_ns) <= before_ns
    assert after_ns <= clock.to_utc_ns(time.monotonic_ns()) < after_ns + 10 * NS_PER_S
