"""The cost of streams without clients: processor time, and the hand-over of positions to the streams.

Positions go to a stream in the publishing thread; the other way is a queue and a thread for each stream. Two
threads do the work of cameras meanwhile: they filter images (without the GIL) and run Python. The time of the
hand-over is from the publishing of a message with three robots until all five streams have sent it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import cv2
import numpy as np
from rounds import Row
from stream_server import free_ports

from ipsys_log.messages import Message, Track, Tracks
from ipsys_log.sinks.sink import FanOut, InlineSink, Sink
from ipsys_log.sinks.streams import StreamSettings
from ipsys_log.sinks.streams.opening import open_streams
from ipsys_log.sinks.streams.poses import StreamContext

__all__ = ["ROBOT", "cost_rows", "hand_over_rows"]

# The interval of positions from three cameras with 30 frames/s.
_PERIOD_S = 0.011
_BUSY_THREADS, _PYTHON_STEPS = 2, 15_000
_LIMIT_S = 60.0
_MS_PER_S = 1e3
# The robot of the lab whose autopilot gets its positions.
ROBOT, _TOPIC = "robot_0", "/runs/poly/tracks"
# Messages with three robots each, for the processor time.
_MESSAGES = 1000


class _Inline:
    """A stream that notes when it has sent a message."""

    def __init__(self, stream: InlineSink, note: Callable[[], None]) -> None:
        self.name, self.payloads = stream.name, stream.payloads
        self._stream, self._note = stream, note

    def send(self, message: Message) -> None:
        self._stream.send(message)
        self._note()


class _Queued:
    """The same as a sink with a queue and a thread."""

    def __init__(self, inline: _Inline) -> None:
        self.name, self.payloads = inline.name, inline.payloads
        self._inline = inline

    def consume(self, messages: Iterator[Message | None]) -> None:
        for message in messages:
            if message is not None:
                self._inline.send(message)


@contextmanager
def _busy() -> Iterator[None]:
    """Keep threads busy, as the detection of markers does."""
    ended = threading.Event()
    image = np.random.default_rng(0).integers(0, 255, (360, 640), dtype=np.uint8)

    def work() -> None:
        while not ended.is_set():
            cv2.GaussianBlur(image, (9, 9), 2)
            for _ in range(_PYTHON_STEPS):
                pass

    threads = [threading.Thread(target=work, daemon=True) for _ in range(_BUSY_THREADS)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def _delays_ms(count: int, is_queued: bool) -> list[float]:
    """Return for each message the time until the last stream has sent it."""
    sent, times_s = threading.Semaphore(0), [0.0]

    def note() -> None:
        times_s[0] = time.perf_counter()
        sent.release()

    delays_ms = []
    with open_streams(_context(_all_streams())) as streams:
        inline = [_Inline(stream, note) for stream in streams]
        sinks: Sequence[Sink] = [_Queued(sink) for sink in inline] if is_queued else inline
        with FanOut(sinks, lambda kind, text: None) as show, _busy():
            for number in range(count):
                time.sleep(_PERIOD_S)
                begin_s = time.perf_counter()
                show(_message(number))
                for _ in sinks:
                    sent.acquire(timeout=_LIMIT_S)
                delays_ms.append(_MS_PER_S * (times_s[0] - begin_s))
    return delays_ms


def _context(settings: StreamSettings) -> StreamContext:
    return StreamContext(settings, {_TOPIC}, lambda: 0, lambda kind, text: None, 1)


def _all_streams() -> StreamSettings:
    """Return two streams of UDP, and one each of MAVLink, VRPN and ROS 2."""
    ros2, mavlink, *udp = free_ports(4)
    targets = tuple(f"127.0.0.1:{port}" for port in udp)
    return StreamSettings(udp=targets, mavlink=(f"{ROBOT}=127.0.0.1:{mavlink}",), vrpn=0, ros2=ros2)


def hand_over_rows(rounds: int, count: int) -> list[Row]:
    """Return the delays of ``count`` messages in both ways, and their ratios; both run in turns."""
    delays_ms: dict[bool, list[list[float]]] = {True: [], False: []}
    for _ in range(rounds):
        for is_queued, of_way in delays_ms.items():
            of_way.append(_delays_ms(count, is_queued))
    rows = []
    for title, share in (("median", 50), ("99 %", 99)):
        queued, prompt = (
            tuple(float(np.percentile(round_ms, share)) for round_ms in delays_ms[way])
            for way in (True, False)
        )
        ratios = tuple(a / b for a, b in zip(queued, prompt, strict=True))
        rows.append(Row(f"queues / inline, to the last stream, {title}", ratios))
        rows.append(Row(f"inline, to the last stream, {title}", prompt, "ms"))
    return rows


def cost_rows(rounds: int) -> list[Row]:
    """Return the processor time of each stream for a message with three robots, without clients.

    Unlike latencies, it does not depend on other programs.
    """
    ros2, udp, mavlink = free_ports(3)
    streams = {
        "UDP": StreamSettings(udp=(f"127.0.0.1:{udp}",)),
        "MAVLink": StreamSettings(mavlink=(f"{ROBOT}=127.0.0.1:{mavlink}",)),
        "VRPN": StreamSettings(vrpn=0),
        "ROS 2": StreamSettings(ros2=ros2),
        "Foxglove": StreamSettings(foxglove=0),
    }
    return [
        Row(f"processor time, {name}", tuple(_cost_ms(settings) for _ in range(rounds)), "ms/message")
        for name, settings in streams.items()
    ]


def _cost_ms(settings: StreamSettings) -> float:
    messages = [_message(number) for number in range(_MESSAGES)]
    with open_streams(_context(settings)) as (stream,):
        for message in messages[:10]:
            stream.send(message)
        begin_s = time.process_time()
        for message in messages[10:]:
            stream.send(message)
        return _MS_PER_S * (time.process_time() - begin_s) / (_MESSAGES - 10)


def _message(number: int) -> Message:
    time_ns = number * 33_000_000
    rows = tuple(_track(n, 0.01 * number) for n in range(3))
    return Message(_TOPIC, time_ns, time_ns, Tracks(time_ns, rows))


def _track(number: int, x_m: float) -> Track:
    """Return a track with all that ``fuse`` gives."""
    return Track(
        f"robot_{number}",
        number,
        x_m,
        float(number),
        0.1,
        0.3,
        np.eye(3) * 1e-4,
        ("red",),
        True,
        velocity_m_s=np.array([0.3, 0.0, 0.0]),
        velocity_covariance_m2_s2=np.eye(3) * 1e-4,
        heading_sigma_rad=0.01,
        turn_rate_rad_s=0.0,
        turn_rate_sigma_rad_s=0.02,
    )
