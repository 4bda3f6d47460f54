"""A centre and nodes in one process, with frames of the test, for tests over a real session."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from threading import Event as Flag
from threading import Thread

from ipsys_log.capture.frames import Clock, Frame, Say, SourceMessage
from ipsys_log.capture.nodes.centre import Centre
from ipsys_log.capture.nodes.network import NodeNetwork
from ipsys_log.capture.nodes.node import Node
from ipsys_log.engine.output import write_message
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import ClockEstimate, CompressedImage, Event, Message, RigCamera, image_topic
from tests.ports import free_port
from tests.waiting import wait_until

# A limit for an event on a busy machine.
PATIENCE_S = 300.0
GUIDE = Path(__file__).resolve().parents[3] / "docs" / "nodes.md"


def make_certificates(folder: Path, address: str, *cameras: str) -> Path:
    """Make certificates by the lines of docs/nodes.md, and return their folder."""
    blocks = re.findall(r"```bash\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    (script,) = (block for block in blocks if "openssl" in block)
    script = script.replace("192.168.1.10", address).replace("red white black", " ".join(cameras))
    folder.mkdir()
    subprocess.run(["bash", "-euc", script], cwd=folder, check=True, capture_output=True, timeout=PATIENCE_S)
    return folder / "certificates"


class ShiftedClock(Clock):
    """A clock that is ahead of another one by a known time."""

    def __init__(self, other: Clock, ahead_ns: int) -> None:
        super().__init__()
        self.other, self.ahead_ns = other, ahead_ns

    def now_ns(self) -> int:
        return self.other.now_ns() + self.ahead_ns


class Feed:
    """The recording of a node: `record` writes frames and hands them to the node."""

    def __init__(self, node: Node, log: LogWriter, camera: str, clock: Clock) -> None:
        self.node, self.clock = node, clock
        self._log, self._camera, self._counts = log, camera, dict[str, int]()
        self._numbers = count()
        self.times_ns: dict[bytes, int] = {}

    def record(self, frames: int) -> list[bytes]:
        """Record frames with the present time; return their bytes."""
        made = []
        for _ in range(frames):
            data = b"%s %d " % (self._camera.encode(), next(self._numbers)) * 1000
            time_ns = self.clock.now_ns()
            payload = CompressedImage(time_ns, self._camera, data, "jpeg")
            message = Message(image_topic(self._camera), time_ns, time_ns, payload, self._camera)
            write_message(self._log, message, self._counts)
            self._log.flush()
            self.node(message)
            self.times_ns[data] = time_ns
            made.append(data)
        return made


@contextmanager
def sending(
    folder: Path,
    network: NodeNetwork,
    camera: str = "red",
    clock: Clock | None = None,
    version: str = "0.1.0",
    say: Say = lambda text: None,
) -> Iterator[Feed]:
    """Open a node whose frames the test makes."""
    clock = clock or Clock()
    path = folder / f"{camera}_{free_port()}.mcap"
    with LogWriter.create(path) as log, Node(camera, network, version, path, clock, say) as node:
        yield Feed(node, log, camera, clock)


@dataclass
class Received:
    """The items of one camera that have arrived at the centre, and the errors that ended it."""

    frames: list[Frame] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    estimates: list[ClockEstimate] = field(default_factory=list)
    errors: list[Exception] = field(default_factory=list)

    def wait_until(self, condition: Callable[[Received], object], name: str) -> None:
        """Wait until a condition holds."""
        wait_until(
            lambda: condition(self), name, lambda: f"{len(self.frames)} frames, {self.events}, {self.errors}"
        )

    def wait_for_data(self, data: list[bytes]) -> None:
        """Wait until frames with these bytes have arrived."""
        self.wait_until(lambda now: set(data) <= {frame.data for frame in now.frames}, "the frames arrive")

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


@contextmanager
def receiving(centre: Centre, camera: str = "red", clock: Clock | None = None) -> Iterator[Received]:
    """Open a camera at the centre, and collect what it sends in a thread, also after disconnections."""
    received, stopped, opened = Received(), Flag(), Flag()
    rig_camera, clock = RigCamera(camera, source=f"zenoh:{camera}"), clock or Clock()

    def work() -> None:
        while not stopped.is_set():
            try:
                with centre.open(rig_camera, clock, lambda text: None) as items:
                    for item in items:
                        if stopped.is_set():
                            return
                        if item is None:
                            stopped.wait(0.001)
                            continue
                        opened.set()
                        _keep(received, item)
                    return
            except Exception as error:
                received.errors.append(error)
                opened.set()

    thread = Thread(target=work)
    thread.start()
    try:
        assert opened.wait(PATIENCE_S)
        yield received
    finally:
        stopped.set()
        thread.join()


def _keep(received: Received, item: Frame | SourceMessage) -> None:
    if isinstance(item, Frame):
        received.frames.append(item)
    else:
        kept = received.events if isinstance(item.payload, Event) else received.estimates
        kept.append(item.payload)
