"""Simulated cameras that play available frames in place of hardware."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from ipsys_log.capture.frames import Clock, Frame, Open, Say
from ipsys_log.messages import CompressedImage, Message, RigCamera
from ipsys_log.units import NS_PER_S

WAIT_LIMIT_S = 240.0
_READING_NS = 1000
_START_NS = 1_700_000_000 * NS_PER_S


def cameras(*names: str) -> list[RigCamera]:
    return [RigCamera(name, source=f"test:{name}") for name in names]


def playing(
    frames: Mapping[str, Sequence[bytes]],
    rate_hz: float,
    stamped: bool = True,
    before: Callable[[str, int], None] = lambda camera, number: None,
    age_ns: Callable[[str, int], int] = lambda camera, number: 1_000_000,
) -> Open:
    """An opener of cameras that send their frames once, in real time; ``before`` is called before each frame.

    All cameras send the frames of one number at one time. ``age_ns`` is the time from the stamp of a frame to
    its arrival; it is negative if the clock of the camera is ahead.
    """
    starts_s: dict[str, float] = {}

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            now_s = time.monotonic()
            start_s = now_s if camera.name in starts_s else min(starts_s.values(), default=now_s)
            starts_s[camera.name] = start_s
            for number, data in enumerate(frames[camera.name]):
                wait_s = start_s + number / rate_hz - time.monotonic()
                if wait_s > 0:
                    time.sleep(wait_s)
                before(camera.name, number)
                yield Frame(data, "jpeg", clock.now_ns() - age_ns(camera.name, number) if stamped else None)

        yield sent()

    return opened


class SteppedClock(Clock):
    """A clock that advances with the frames: a busy machine skips no frame, and stamps are exact.

    Give ``before`` to `playing`, with an infinite rate, and ``watch`` to the observer of the frames. Frame
    n is sent after all frames n - 1 were observed. The time is then n / ``rate_hz`` after the start.
    """

    def __init__(self, names: Sequence[str], rate_hz: float) -> None:
        super().__init__()
        self._names, self._step_ns = tuple(names), round(NS_PER_S / rate_hz)
        # A fixed time: detection clears its memory at absolute times.
        self._start_ns = self._now_ns = _START_NS
        self._seen: Counter[str] = Counter()
        self._changed = threading.Condition()

    def now_ns(self) -> int:
        with self._changed:
            self._now_ns += _READING_NS
            return self._now_ns

    def before(self, _: str, number: int) -> None:
        """Wait until frame ``number`` may be sent, and advance the clock to its time."""
        with self._changed:
            looked_at = self._changed.wait_for(
                lambda: all(self._seen[name] >= number for name in self._names), WAIT_LIMIT_S
            )
            assert looked_at, f"frames {number - 1} were not looked at: {self._seen}"
            self._now_ns = max(self._now_ns, self._start_ns + number * self._step_ns)

    def watch(self, message: Message) -> None:
        """Note that a frame was observed."""
        if isinstance(message.payload, CompressedImage):
            with self._changed:
                self._seen[str(message.camera)] += 1
                self._changed.notify_all()
