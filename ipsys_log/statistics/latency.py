"""Latency ledger: the wall-clock time of each processing step of a position."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import LATENCY_TOPIC, Latency, Message
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


def recorded_latencies(paths: Sequence[LogLocation]) -> list[Latency]:
    """Return the latency ledger of a log.

    Raises
    ------
    IpsysError
        The log has no latencies.
    """
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
    times_ns = np.array(
        [[getattr(entry, _field(step)) for step in STEPS] for entry in entries], dtype=np.int64
    )
    times_ns = times_ns.reshape(-1, len(STEPS))
    took_s = np.diff(times_ns, axis=1) / NS_PER_S
    durations_s = {step: took_s[:, n] for n, step in enumerate(STEPS[1:])}
    durations_s["received"] = durations_s["received"][durations_s["received"] > 0]
    return {**durations_s, "total": (times_ns[:, -1] - times_ns[:, 1]) / NS_PER_S}


def _field(step: str) -> str:
    return "timestamp" if step == "captured" else step


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
