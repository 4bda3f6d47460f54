"""Latency ledger: the wall-clock time of each processing step of a position; and late positions."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import FRAME_SKIPPED, LATENCY_TOPIC, Latency, Markers, Message
from ipsys_log.messages.channels import LATENCY, MARKERS, POSITIONS, TRACKS, Channel
from ipsys_log.units import NS_PER_S

STEPS = ("captured", "received", "detected", "located", "fused", "published")
# Frames whose times are kept: more than those that wait for the stages, of 24 cameras too.
_REMEMBERED = 2_000
# The step that is done when a message of a channel is made.
_STEP_OF = {MARKERS: "detected", POSITIONS: "located", TRACKS: "fused"}


class Ledger:
    """A ledger of the times of frames in the processing steps. It is telemetry: no stage reads it.

    Parameters
    ----------
    now_ns : the wall clock.
    received_ns : arrival times of frames, by log time.
    """

    def __init__(self, now_ns: Callable[[], int], received_ns: Mapping[int, int]) -> None:
        self._now_ns, self._received_ns = now_ns, received_ns
        # By log time of the frame, the times of its steps; those of each model by the run of that model.
        self._times_ns: dict[int, dict[tuple[str, str], int]] = {}

    def note(self, channel: Channel, run: str, messages: Iterable[Message]) -> Iterator[Message]:
        """Yield the messages unchanged; a message of this channel and run ends a step for its frame.

        The log time of the message identifies the frame.
        """
        step, payloads = _STEP_OF.get(channel), channel.payloads
        for message in messages:
            if (
                step is not None
                and isinstance(message.payload, payloads)
                and run_of_topic(message.topic) == run
            ):
                of_model = "" if step == "detected" else run
                self._times_ns.setdefault(message.log_time_ns, {})[step, of_model] = self._now_ns()
                if len(self._times_ns) > _REMEMBERED:
                    del self._times_ns[next(iter(self._times_ns))]
            yield message

    def entry(self, message: Message) -> Message | None:
        """Return the times of a position that was just published; None for any other message."""
        times_ns = self._times_ns.get(message.log_time_ns, {})
        received_ns = self._received_ns.get(message.log_time_ns)
        run = run_of_topic(message.topic) or ""
        if message.topic != TRACKS.topic_of(run) or received_ns is None:
            return None
        latency = Latency(
            message.publish_time_ns,
            str(message.camera),
            received_ns,
            times_ns.get(("detected", ""), received_ns),  # markers of a node arrive detected
            times_ns["located", run],
            times_ns["fused", run],
            self._now_ns(),
        )
        return Message(LATENCY_TOPIC, message.log_time_ns, message.publish_time_ns, latency, message.camera)


# A robot at 1 m/s moves 25 cm in this time.
LATE_S = 0.25
_WINDOW_NS = NS_PER_S
# Below this share of the frames, the computer is too slow.
_KEPT_UP = 0.9
# A change of the state is said if it lasts for some seconds, and at most every ten.
_CHECK_NS, _LASTS_NS, _SAID_NS = NS_PER_S, 2 * NS_PER_S, 10 * NS_PER_S
_FEWER_IMAGES = (
    "Use fewer or smaller images (rate_hz, width and height in the rig), fewer models, or nodes that detect"
)


class PositionState(NamedTuple):
    """The state of the positions of a live run.

    ``state`` is ``live``, ``late`` (the median age of the last second is above 0.25 s) or ``stale`` (no
    position in the last second). ``age_s`` is that median; of stale positions, the age of the newest one, or
    None without any. ``cause`` and ``remedy`` are empty if there is no fault.
    """

    state: str
    age_s: float | None
    cause: str = ""
    remedy: str = ""

    @property
    def summary(self) -> str:
        """The state with its age, such as ``late: 14.0 s``."""
        if self.state == "live":
            return "live"
        return f"{self.state}: " + ("no position yet" if self.age_s is None else f"{self.age_s:.1f} s")

    def __str__(self) -> str:
        return ". ".join(part for part in (self.summary, self.cause, self.remedy) if part)


class Counted(Protocol):
    """The state of a camera."""

    frames: int


class PositionMonitor:
    """The state of the positions of a live run. It is telemetry: no stage reads it, and no log has it.

    The thread that publishes messages calls the monitor; any thread may ask for the state.

    Parameters
    ----------
    now_ns : the clock of the ages.
    cameras : they have the numbers of the frames that have arrived so far.
    say : called with the text of a state that lasts, and of its end.
    """

    def __init__(
        self, now_ns: Callable[[], int], cameras: Mapping[str, Counted], say: Callable[[str], None]
    ) -> None:
        self._now_ns, self._cameras, self._say = now_ns, cameras, say
        self._lock = threading.Lock()
        self._latencies: deque[Latency] = deque()
        # Times of processed frames, of skipped frames, and of counts of the frames that had arrived.
        self._processed: deque[int] = deque()
        self._skipped: deque[int] = deque()
        self._counts: deque[tuple[int, int]] = deque()
        self._frame_ns: int | None = None
        self._checked_ns = self._said_ns = self._since_ns = -_SAID_NS
        self._found = self._said = "fine"

    def __call__(self, message: Message) -> None:
        """Note a published message: markers of a frame, a skipped frame, or the times of a position."""
        payload = message.payload
        is_skipped = getattr(payload, "kind", None) == FRAME_SKIPPED
        if isinstance(payload, Latency):
            with self._lock:
                self._latencies.append(payload)
        elif is_skipped or (isinstance(payload, Markers) and message.log_time_ns != self._frame_ns):
            now_ns = self._now_ns()
            with self._lock:
                if is_skipped:
                    self._skipped.append(now_ns)
                else:
                    self._frame_ns = message.log_time_ns  # the markers of a node come twice
                    self._processed.append(now_ns)
                    self._counts.append((now_ns, self._arrived()))
            if now_ns - self._checked_ns >= _CHECK_NS:
                self._checked_ns = now_ns
                self._report(now_ns)

    @property
    def state(self) -> PositionState | None:
        """The state now; None before the first processed frame."""
        with self._lock:
            return self._judge(self._now_ns()) if self._counts else None

    def _arrived(self) -> int:
        return sum(camera.frames for camera in self._cameras.values())

    def _judge(self, now_ns: int) -> PositionState:
        begin_ns = now_ns - _WINDOW_NS
        while len(self._counts) > 1 and self._counts[1][0] <= begin_ns:
            self._counts.popleft()
        since_ns, count = self._counts[0]
        for times_ns in (self._processed, self._skipped):
            while times_ns and times_ns[0] <= since_ns:
                times_ns.popleft()
        while len(self._latencies) > 1 and self._latencies[0].published <= begin_ns:
            self._latencies.popleft()
        seconds = max((now_ns - since_ns) / NS_PER_S, 1e-9)
        done = len(self._processed)
        arrived = max(self._arrived() - count, done + len(self._skipped))
        is_slow = done < _KEPT_UP * arrived
        slow = f"This computer processes {done / seconds:.0f} of {arrived / seconds:.0f} frames/s"
        recent = [one for one in self._latencies if one.published > begin_ns]
        if not recent:
            age_s = (now_ns - self._latencies[-1].timestamp) / NS_PER_S if self._latencies else None
            if not arrived:
                return PositionState("stale", age_s, "No camera sends frames", "Check cables and power")
            if is_slow:
                return PositionState("stale", age_s, slow, _FEWER_IMAGES)
            return PositionState("stale", age_s, "No camera sees a robot")
        age_s = median(one.published - one.timestamp for one in recent) / NS_PER_S
        worked_s = median(one.published - one.received for one in recent) / NS_PER_S
        if age_s <= LATE_S:
            fault = (slow, _FEWER_IMAGES) if is_slow and self._skipped else ()
            return PositionState("live", age_s, *fault)
        if worked_s < age_s / 2:
            cause = f"Frames arrive {age_s - worked_s:.1f} s after their exposure"
            return PositionState("late", age_s, cause, "Check the network, and the clocks of cameras")
        if not is_slow:
            slow = f"The computation of a position takes {worked_s:.1f} s"
        return PositionState("late", age_s, slow, _FEWER_IMAGES)

    def _report(self, now_ns: int) -> None:
        """Say a fault that lasts, and its end. Without a robot, stale positions are no fault."""
        state = self.state
        if state is None:
            return
        found = state.state if state.remedy else "fine"
        if found != self._found:
            self._found, self._since_ns = found, now_ns
        lasts = now_ns - self._since_ns >= _LASTS_NS
        if lasts and found != self._said and now_ns - self._said_ns >= _SAID_NS:
            self._said, self._said_ns = found, now_ns
            self._say(f"positions are {state}")


def recorded_latencies(paths: Sequence[LogLocation]) -> list[Latency]:
    """Return the latency ledger of a log."""
    with Session(paths) as session:
        latencies: list[Latency] = session.payloads(session.topics(LATENCY))
        if not latencies:
            raise IpsysError(f"{session}: has no latencies; only 'ipsys live' writes them")
    return latencies


def step_times_s(entries: Iterable[Latency]) -> dict[str, NDArray[np.float64]]:
    """Return the duration of each step, and ``total`` from the arrival of a frame to publishing, in s.

    ``received`` is the time from the exposure to the arrival of a frame: the latency of camera and cable. It
    is unknown for cameras without capture stamps.
    """
    fields = ["timestamp" if step == "captured" else step for step in STEPS]
    rows = [[getattr(entry, field) for field in fields] for entry in entries]
    times_ns = np.array(rows, dtype=np.int64).reshape(-1, len(STEPS))
    took_s = np.diff(times_ns, axis=1) / NS_PER_S
    durations_s = {step: took_s[:, n] for n, step in enumerate(STEPS[1:])}
    durations_s["received"] = durations_s["received"][durations_s["received"] > 0]
    return {**durations_s, "total": (times_ns[:, -1] - times_ns[:, 1]) / NS_PER_S}


@dataclass(frozen=True, slots=True)
class Percentiles:
    """The percentiles of the duration of one step, in s."""

    median_s: float
    p90_s: float
    p99_s: float
    max_s: float


def latency_percentiles(times_s: Mapping[str, NDArray[np.float64]]) -> dict[str, Percentiles]:
    """Return median, 90th and 99th percentile and maximum of each step."""
    percentiles = {}
    for step, values in times_s.items():
        if len(values):
            median_s, p90_s, p99_s, max_s = np.percentile(values, [50, 90, 99, 100]).tolist()
            percentiles[step] = Percentiles(median_s, p90_s, p99_s, max_s)
    return percentiles
