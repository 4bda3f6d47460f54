"""The state of live positions, from given stamps: live, late or stale, with the cause."""

from dataclasses import dataclass, field
from typing import Any

import pytest

from ipsys_log.capture.frames import CameraState
from ipsys_log.messages import EVENTS_TOPIC, FRAME_SKIPPED, LATENCY_TOPIC, Event, Latency, Markers, Message
from ipsys_log.statistics.latency import PositionMonitor
from ipsys_log.units import NS_PER_S


@dataclass
class Run:
    """A live run of some cameras by a clock of the test."""

    now_ns: int = 1_700_000_000 * NS_PER_S
    said: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.camera = CameraState()
        self.monitor = PositionMonitor(lambda: self.now_ns, {"red": self.camera}, self.said.append)

    def go(
        self,
        seconds: float,
        arriving_hz: int,
        processed_hz: int,
        age_s: float | None = 0.03,
        worked_s: float = 0.02,
        skips: bool = True,
    ) -> None:
        """Let frames arrive and be processed; without an age, they show no robot."""
        done = 0.0
        for _ in range(round(seconds * arriving_hz)):
            self.now_ns += NS_PER_S // arriving_hz
            self.camera.frames += 1
            done += processed_hz / arriving_hz
            if done < 1:
                event = Event(self.now_ns, FRAME_SKIPPED, "a frame is skipped", "red")
                if skips:
                    self.monitor(Message(EVENTS_TOPIC, self.now_ns, self.now_ns, event))
                continue
            done -= 1
            markers = Message(
                "/runs/edges/cameras/red/markers", self.now_ns, self.now_ns, Markers(0, (), 1, 1)
            )
            self.monitor(markers)
            self.monitor(markers)  # those of a node come twice
            if age_s is not None:
                received_ns = self.now_ns - round(worked_s * NS_PER_S)
                time_ns = self.now_ns - round(age_s * NS_PER_S)
                steps_ns = received_ns, received_ns, received_ns, self.now_ns
                entry = Latency(time_ns, "red", received_ns, *steps_ns)
                self.monitor(Message(LATENCY_TOPIC, self.now_ns, self.now_ns, entry))

    @property
    def state(self) -> tuple[str, str]:
        state = self.monitor.state
        assert state is not None
        assert bool(state.remedy) == bool(state.cause) or state.cause == "No camera sees a robot"
        return state.summary, state.cause


@pytest.mark.parametrize(
    ("given", "summary", "cause"),
    [
        ((90, 90), "live", ""),
        ((90, 12, 14.0, 13.9), "late: 14.0 s", "This computer processes 12 of 90 frames/s"),
        # The recorder, too, cannot keep up: frames wait in memory, and none is skipped yet.
        ((90, 12, 14.0, 13.9, False), "late: 14.0 s", "This computer processes 12 of 90 frames/s"),
        ((100, 5, 0.1), "live", "This computer processes 5 of 100 frames/s"),
        ((10, 10, 0.25), "live", ""),
        ((10, 10, 0.26, 0.24), "late: 0.3 s", "The computation of a position takes 0.2 s"),
        ((30, 30, 0.8), "late: 0.8 s", "Frames arrive 0.8 s after their exposure"),
        ((30, 30, None), "stale: no position yet", "No camera sees a robot"),
    ],
)
def test_state_is_that_of_the_last_second(given: tuple[Any, ...], summary: str, cause: str) -> None:
    run = Run()
    assert run.monitor.state is None
    run.go(3.0, 50, 50, None)
    run.go(1.2, *given)
    assert run.state == (summary, cause)


def test_positions_without_news_for_a_second_are_stale() -> None:
    run = Run()
    run.go(2.0, 30, 30)
    run.now_ns += NS_PER_S // 2
    assert run.state[0] == "live"
    run.now_ns += NS_PER_S
    assert run.state == ("stale: 1.5 s", "No camera sends frames")
    run.camera.frames += 30
    assert run.state == ("stale: 1.5 s", "This computer processes 0 of 20 frames/s")
    run.go(2.0, 30, 30, None)
    assert run.state == ("stale: 3.5 s", "No camera sees a robot")


def test_fault_is_said_while_it_lasts_and_at_its_end() -> None:
    run = Run()
    run.go(5.0, 30, 30)
    run.go(0.5, 30, 3, 0.6, 0.5)  # too short
    run.go(5.0, 30, 30)
    assert run.said == []
    run.go(60.0, 100, 5, 0.1)
    (text,) = run.said
    assert text.startswith("positions are live. This computer processes 5 of 100 frames/s. Use fewer")
    run.go(20.0, 30, 30)
    assert run.said[1:] == ["positions are live"]
