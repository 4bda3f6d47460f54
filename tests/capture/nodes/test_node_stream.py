"""The stream of a node at the centre: every frame once, gaps, sessions, versions and jumps of the clock."""

from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.capture.frames import Frame, NodeRefusedError, SourceError, SourceMessage
from ipsys_log.capture.nodes.stream import NodeStream
from ipsys_log.capture.nodes.wire import FrameHeader, FrameRequest, NodeState, StateRequest
from ipsys_log.messages import ClockEstimate, Event, RigCamera
from ipsys_log.units import NS_PER_S

START_NS = 1_700_000_000 * NS_PER_S
ONE, TWO, THREE = "00000000000000a1", "00000000000000b2", "00000000000000c3"
KEYFRAME = b"\0\0\0\1\x67parameters\0\0\0\1\x65image"
HOUR_NS = 3600 * NS_PER_S


class Bench:
    """A stream with a node whose clock is behind by ``behind_ns``; the network takes no time."""

    def __init__(self, format: str = "jpeg", camera: RigCamera | None = None, behind_ns: int = 0) -> None:
        self.stream = NodeStream(camera or RigCamera("red"), "0.1.0")
        self.format, self.behind_ns, self.now_ns = format, behind_ns, START_NS
        self.frames: list[Frame] = []
        self.events: list[Event] = []
        self.estimates: list[ClockEstimate] = []

    def _keep(self, items: Iterable[Frame | SourceMessage]) -> None:
        for item in items:
            if isinstance(item, Frame):
                self.frames.append(item)
            elif isinstance(item.payload, Event):
                self.events.append(item.payload)
            else:
                self.estimates.append(item.payload)

    def state(self, count: int, session: str = ONE, after_s: float = 0.1, **changes: Any) -> None:
        self.now_ns += round(after_s * NS_PER_S)
        at_ns = self.now_ns - self.behind_ns
        state = NodeState("0.1.0", session, at_ns, at_ns, count, False)._replace(**changes)
        self._keep(self.stream.take_state(state, self.now_ns, self.now_ns))

    def frame(self, number: int, is_late: bool = False, session: str = ONE, age_s: float = 0.02) -> None:
        data = KEYFRAME if number % 10 == 0 else b"\0\0\0\1\x41%d" % number
        time_ns = self.now_ns - self.behind_ns - round(age_s * NS_PER_S)
        header = FrameHeader(session, number, time_ns, self.format)
        self._keep(self.stream.take_frame(header, data if self.format != "jpeg" else b"%d" % number,
                                          self.now_ns, is_late))  # fmt: skip

    def numbers(self) -> list[int]:
        return [int(frame.data) for frame in self.frames]

    def send_missing(self) -> None:
        """Answer all requests of the centre."""
        for _ in range(100):
            if (request := self.stream.frame_request()) is None:
                return
            for number in range(request.first, request.end):
                self.frame(number, is_late=True, session=request.session)
        raise AssertionError("the centre asks for ever")


def test_frames_before_the_recording_are_not_missing() -> None:
    bench = Bench()
    bench.state(count=100)
    for number in (98, 99, 100, 101):
        bench.frame(number)
    assert bench.numbers() == [100, 101]
    assert bench.events == []
    assert bench.stream.state_request() == StateRequest("0.1.0", ONE, 102)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(lost=st.sets(st.integers(0, 59)), twice=st.sets(st.integers(0, 59)))
def test_every_frame_arrives_once_whatever_is_lost(lost: set[int], twice: set[int]) -> None:
    bench = Bench()
    bench.state(count=0)
    for number in range(60):
        if number not in lost:
            bench.frame(number)
        if number in twice - lost:
            bench.frame(number)
        if number % 7 == 0:
            bench.send_missing()
    bench.state(count=60)
    bench.state(count=60, after_s=1.5)
    bench.send_missing()
    assert sorted(bench.numbers()) == list(range(60))
    assert bench.stream.frame_request() is None
    assert {event.kind for event in bench.events} == ({"node_gap", "node_gap_filled"} if lost else set())


@settings(max_examples=40, deadline=None, derandomize=True)
@given(lost=st.sets(st.integers(0, 59)), every=st.integers(1, 9))
def test_packets_of_a_video_keep_their_order(lost: set[int], every: int) -> None:
    bench = Bench("h264")
    bench.state(count=0)
    for number in range(60):
        if number not in lost:
            bench.frame(number)
        request = bench.stream.frame_request()
        if number % every == 0 and request is not None:
            for missing in range(request.first, request.end):
                bench.frame(missing, is_late=True)
    bench.state(count=60)
    bench.state(count=60, after_s=1.5)
    bench.send_missing()
    data = [KEYFRAME if number % 10 == 0 else b"\0\0\0\1\x41%d" % number for number in range(60)]
    assert [frame.data for frame in bench.frames] == data


def test_late_packet_of_a_video_waits_for_its_turn() -> None:
    bench = Bench("h264")
    bench.state(count=0)
    for number in (0, 3):
        bench.frame(number)
    bench.frame(2, is_late=True)
    assert len(bench.frames) == 1
    bench.send_missing()
    assert len(bench.frames) == 4


def test_video_begins_with_a_keyframe() -> None:
    bench = Bench("h264")
    bench.state(count=95)
    for number in range(95, 103):
        bench.frame(number)
    assert bench.frames[0].data == KEYFRAME
    assert len(bench.frames) == 3
    assert bench.events == []


def test_gap_is_named_and_requests_are_small() -> None:
    bench = Bench()
    bench.state(count=0)
    bench.frame(0)
    bench.frame(41)
    (gap,) = bench.events
    assert (gap.kind, gap.camera) == ("node_gap", "red")
    assert "frames 1 to 40 of its node are missing" in gap.text
    assert bench.stream.frame_request() == FrameRequest(ONE, 1, 17)
    bench.send_missing()
    assert bench.events[-1].kind == "node_gap_filled"
    assert "40 late" in bench.events[-1].text


def test_lost_tail_is_found_without_a_later_frame() -> None:
    bench = Bench()
    bench.state(count=0)
    bench.frame(0)
    bench.state(count=5)
    assert bench.stream.frame_request() is None  # perhaps they are on the way
    bench.state(count=5, after_s=1.1)
    assert bench.stream.frame_request() == FrameRequest(ONE, 1, 5)
    bench.send_missing()
    assert not bench.stream.has_ended
    bench.state(count=5, has_ended=True)
    assert bench.stream.has_ended


def test_frame_that_the_node_cannot_read_is_named_as_lost() -> None:
    bench = Bench()
    bench.state(count=0)
    bench.frame(0)
    bench.frame(2)
    bench._keep(bench.stream.lose(FrameHeader(ONE, 1, 0, "jpeg"), bench.now_ns))
    assert [event.kind for event in bench.events] == ["node_gap", "node_frames_lost", "node_gap_filled"]
    assert bench.stream.frame_request() is None


def test_restarted_node_sends_all_frames_of_its_new_session() -> None:
    bench = Bench()
    bench.state(count=7)
    bench.frame(7)
    bench.frame(9)
    bench.frame(0, session=TWO)  # not announced yet
    for _ in range(22):
        bench.state(count=2, session=TWO)
    bench.frame(1, session=TWO)
    assert [event.kind for event in bench.events] == ["node_gap", "node_restarted", "node_gap"]
    assert "1 frames before are only in the log of the node" in bench.events[1].text
    assert bench.stream.frame_request() == FrameRequest(TWO, 0, 1)


def test_two_nodes_with_one_name_are_refused() -> None:
    bench = Bench()
    bench.state(count=7)
    with pytest.raises(SourceError, match="camera red: two nodes send as camera red; end one of them"):
        bench.state(count=2, session=TWO, after_s=0)  # both answer one request
    assert bench.events == []
    other = Bench()
    for session in (ONE, TWO):
        other.state(count=7, session=session)
    with pytest.raises(SourceError, match="two nodes send as camera red"):
        other.state(count=8, session=ONE)


def test_second_node_during_a_recording_is_refused_and_sends_nothing() -> None:
    """The order of both answers to a request varies; the second node ends, and the first one sends on."""
    bench = Bench()
    bench.state(count=0)
    for number in range(100):
        sessions = (ONE, TWO) if number % 3 else (TWO, ONE)
        bench.now_ns += NS_PER_S // 10
        for session in sessions if 30 < number < 90 else (ONE,):
            bench.state(count=number, session=session, after_s=0)
            bench.frame(number, session=session)
    assert bench.numbers() == list(range(100))
    (refusal,) = bench.events
    assert refusal.kind == "node_refused"
    assert "two nodes send as camera red, and the second one is refused; end one" in refusal.text


def test_node_that_ends_leaves_its_camera_to_the_second_one() -> None:
    bench = Bench()
    for _ in range(30):
        bench.state(count=0)
    for number in range(60):
        bench.state(count=number, session=TWO)
        bench.frame(number, session=TWO)
        bench.send_missing()
        if number < 10:
            bench.state(count=0, after_s=0)
    assert [event.kind for event in bench.events[:2]] == ["node_refused", "node_restarted"]
    assert sorted(bench.numbers()) == list(range(60))


def test_other_version_is_refused_with_both_versions() -> None:
    with pytest.raises(SourceError, match=r"its node has ipsys 0\.2\.0, but this machine has ipsys 0\.1\.0;"):
        Bench().state(count=7, version="0.2.0")


def test_node_that_changes_its_version_is_refused_until_it_fits() -> None:
    bench = Bench()
    bench.state(count=7)
    bench.frame(7)
    for _ in range(20):  # perhaps the first node answers again
        bench.state(count=2, session=TWO, version="0.2.0")
    with pytest.raises(NodeRefusedError) as error:
        bench.state(count=2, session=TWO, version="0.2.0")
    assert str(error.value) == (
        "camera red: its node has ipsys 0.2.0 now, but this machine has ipsys 0.1.0, so its frames are not "
        "recorded; install ipsys 0.1.0 on its host, and start the node again"
    )
    bench.frame(0, session=TWO)
    for _ in range(22):
        bench.state(count=0, session=THREE)
    bench.frame(0, session=THREE)
    assert bench.numbers() == [7, 0]
    assert [event.kind for event in bench.events] == ["node_restarted"]


def test_second_node_of_another_version_does_not_stop_the_first() -> None:
    bench = Bench()
    for number in range(60):
        bench.state(count=number)
        if number > 30:
            bench.state(count=0, session=TWO, after_s=0, version="0.2.0")
        bench.frame(number)
    assert bench.numbers() == list(range(60))
    assert [event.kind for event in bench.events] == ["node_refused"]


def test_times_are_those_of_the_centre_also_with_an_exposure() -> None:
    """The node gives the middle of the exposure; the reader of the camera adds half of the exposure."""
    camera = RigCamera("red", height=100, row_time_ns=1000, exposure_s=0.01, stamp="end", latency_ns=500)
    bench = Bench(camera=camera, behind_ns=HOUR_NS)
    bench.state(count=0)
    bench.frame(0)
    added_ns = -500 - 99 * 1000 - 5_000_000
    assert bench.frames[0].time_ns == bench.now_ns - 20_000_000 - added_ns
    (estimate,) = bench.estimates
    assert (estimate.offset_ns, estimate.session, estimate.camera) == (HOUR_NS, ONE, "red")


def test_clock_that_jumps_by_an_hour_is_named_and_no_time_is_wrong() -> None:
    bench = Bench()
    bench.state(count=0)
    bench.frame(0)
    bench.behind_ns = -HOUR_NS
    bench.frame(1)  # no exchange shows the jump yet
    assert bench.stream.frame_request() is None
    bench.state(count=2)
    bench.frame(1, is_late=True, age_s=0.12)
    bench.frame(2)
    times = [frame.time_ns for frame in bench.frames]
    assert times == pytest.approx([START_NS + 80_000_000, START_NS + 80_000_000, START_NS + 180_000_000])
    (jump,) = (event for event in bench.events if event.kind == "clock_jumped")
    assert "the clock of its node jumped by +3600.000 s" in jump.text
