"""A dashboard of a recording that a test feeds with messages, and its page."""

import queue
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ipsys_log.app.web.dashboard.app import build_dashboard
from ipsys_log.app.web.dashboard.operator import Operator
from ipsys_log.app.web.dashboard.state import Dashboard, DashboardSetting
from ipsys_log.app.web.server import PageServer, serve_app
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.live_check import FrameCheck
from ipsys_log.messages import (
    EVENTS_TOPIC,
    LATENCY_TOPIC,
    CompressedImage,
    Event,
    Floor,
    Latency,
    Marker,
    Markers,
    Message,
    Position,
    Positions,
    ReferencePoint,
    Rig,
    RigMarker,
    Track,
    Tracks,
    image_topic,
)
from ipsys_log.statistics.latency import PositionMonitor
from ipsys_log.units import NS_PER_S
from tests.playing import WAIT_LIMIT_S
from tests.stages.drawing import jpeg

BEGIN_NS = 1_700_000_000 * NS_PER_S
# A turn by 0.5 about the vertical after a tilt of 0.3.
TILTED = {"rotation_rad": Rotation.from_euler("xz", [0.3, 0.5]).as_rotvec()}
RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    markers=(RigMarker(0, robot="robot_0"), RigMarker(1, robot="robot_1"), RigMarker(9)),
    reference_points=(ReferencePoint("A", 1.0, 1.0), ReferencePoint("B", 3.0, 1.0)),
    floor=Floor(4.0, 3.0),
)


class LiveLab:
    """A recording, by default with two cameras, whose clock and messages are those of the test.

    Attributes
    ----------
    written : payloads that the page has written to the log; ``said`` are the texts on the terminal.
    """

    def __init__(
        self,
        log: Path,
        model: Any = None,
        lenses: Any = None,
        streams: Iterable[Any] = (),
        cameras: Iterable[str] = ("red", "white"),
        rig: Rig = RIG,
    ) -> None:
        self.time_ns = BEGIN_NS
        self.written: list[Event] = []
        self.said: list[str] = []
        self.states = {name: CameraState(frames=30, up=True, delay_s=0.004) for name in cameras}
        self.checks = {"red": FrameCheck((0,), (), 120.0, 1.0, ("the image is blurred: add light",))}
        setting = DashboardSetting(
            *(rig, lenses or {}, model, "poly", self.states, self.checks, log, self.now_ns, tuple(streams)),
            positions=PositionMonitor(self.now_ns, self.states, self.said.append),
        )
        self._note = setting.positions
        self.operator = Operator(self.write, self.now_ns, self.said.append)
        self.dashboard = Dashboard(setting, self.operator)
        self._queue: queue.SimpleQueue[Message | threading.Event | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self.dashboard.consume, args=(self._messages(),), daemon=True)
        self._thread.start()

    def now_ns(self) -> int:
        return self.time_ns

    def write(self, topic: str, payload: Any) -> None:
        """Write an event; as in a recording, the sink gets it after that."""
        assert topic == EVENTS_TOPIC
        self.written.append(payload)
        self.feed(Message(topic, self.time_ns, payload.timestamp, payload))

    def feed(self, *messages: Message) -> None:
        """Let the sink consume messages; return after that."""
        consumed = threading.Event()
        for message in messages:
            if self._note is not None:
                self._note(message)
            self._queue.put(message)
        self._queue.put(consumed)
        assert consumed.wait(WAIT_LIMIT_S)

    def end(self) -> None:
        """End the messages."""
        self._queue.put(None)
        self._thread.join()

    def _messages(self) -> Iterator[Message]:
        while (item := self._queue.get()) is not None:
            if isinstance(item, threading.Event):
                item.set()  # the sink asks for the next message: it has consumed the last one
            else:
                yield item

    def run(self, seconds: float) -> None:
        """Advance the clock by some seconds."""
        self.time_ns += round(seconds * NS_PER_S)


def tracks(time_ns: int, *robots: Track, run: str = "poly") -> Message:
    return Message(f"/runs/{run}/tracks", time_ns, time_ns, Tracks(time_ns, robots))


def robot(number: int, x_m: float, y_m: float, **values: Any) -> Track:
    covariance_m2 = np.diag([4e-4, 1e-4, 1e-4])
    given: dict[str, Any] = {"heading_rad": 0.5, "covariance_m2": covariance_m2, "cameras": ("red",)}
    name = f"robot_{number}" if number < 9 else f"marker_{number}"
    return Track(name, number, x_m, y_m, 0.1, **{**given, **values})


def event(time_ns: int, kind: str, text: str, camera: str | None = None) -> Message:
    return Message(EVENTS_TOPIC, time_ns, time_ns, Event(time_ns, kind, text, camera))


def frame(time_ns: int, camera: str = "red") -> Message:
    grey = np.tile(np.arange(320, dtype=np.uint8), (180, 1))
    payload = CompressedImage(time_ns, camera, jpeg(grey), "jpeg")
    return Message(image_topic(camera), time_ns, time_ns, payload, camera)


def markers(time_ns: int, camera: str = "red", marker_id: int = 0) -> Message:
    corners_px = np.array([[100.0, 60], [140, 60], [140, 100], [100, 100]])
    payload = Markers(time_ns, (Marker(marker_id, corners_px),), 320, 180)
    return Message(f"/runs/edges/cameras/{camera}/markers", time_ns, time_ns, payload, camera)


def latency(time_ns: int, waited_s: float = 0.0) -> Message:
    """A position that took 10 ms to detect, 1 ms to locate, 2 ms to fuse and 1 ms to publish."""
    steps_ms = np.cumsum([5, 10 + round(waited_s * 1000), 1, 2, 1]) * 1_000_000
    return Message(
        LATENCY_TOPIC, time_ns, time_ns, Latency(time_ns, "red", *(time_ns + steps_ms).tolist()), "red"
    )


def positions(time_ns: int, camera: str, x_m: float) -> Message:
    payload = Positions(time_ns, (Position(0, x_m, 1.0, 0.1, inside=True),))
    return Message(f"/runs/poly/cameras/{camera}/positions", time_ns, time_ns, payload, camera)


@contextmanager
def page_of(
    dashboard: Dashboard, host: str | None = None, port: int = 0, **options: Any
) -> Iterator[PageServer]:
    with serve_app(build_dashboard(dashboard), host, port, has_viewers=True, **options) as page:
        yield page
        assert page.exceptions.count == 0, page.exceptions.first
