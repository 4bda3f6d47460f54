"""Buffer of recent frames: those around a measurement are written to the log, the others discarded."""

from __future__ import annotations

from collections import deque
from types import TracebackType

from ipsys_log.capture.disk import Confirm
from ipsys_log.capture.recorder import Recording
from ipsys_log.errors import WriteError
from ipsys_log.messages import FRAME_SKIPPED, CompressedImage, Event, Measurement, Message
from ipsys_log.units import NS_PER_S

__all__ = ["Recent"]

# Longer than a marker is looked at, and what the stages may be behind.
_HELD_NS = 5 * NS_PER_S
# Two seconds of eight cameras at 60/s are less. Beyond that a place gets what is held of its second.
_LIMIT_BYTES = 256 << 20
# A marker may be exposed so long after the time of its frame (rolling shutter).
_ROLLING_NS = NS_PER_S // 10


class Recent:
    """The end of a recording that is not written yet. A context manager: on leaving, the rest is.

    Everything comes and goes in the order of log times. A frame that is older than some seconds is forgotten,
    sooner where all that is held would be too much for the memory, and any other message written then. A
    measurement is written at once, and before it the frames since its marker lay still, as if everything were
    recorded.

    Parameters
    ----------
    log : where all of it goes.
    limit_bytes : what may be held of frames.
    """

    def __init__(self, log: Recording, limit_bytes: int = _LIMIT_BYTES) -> None:
        self._log = log
        self._limit_bytes, self._held_bytes = limit_bytes, 0
        self._held: deque[Message] = deque()

    def __enter__(self) -> Recent:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not isinstance(error, (WriteError, KeyboardInterrupt)):
            self._write()

    @property
    def full(self) -> WriteError | None:
        return self._log.full

    @property
    def fault(self) -> OSError | None:
        return self._log.fault

    def put(self, message: Message) -> None:
        """Take the next message of a recording.

        Raises
        ------
        WriteError
            Where the disk is full.
        """
        payload = message.payload
        # It tells a replay what live results lack; here there are none.
        if isinstance(payload, Event) and payload.kind == FRAME_SKIPPED:
            return
        self._held.append(message)
        self._held_bytes += _bytes_of(message)
        if isinstance(payload, Measurement):
            self._write(None if payload.still is None else payload.still.start - _ROLLING_NS)
        while _is_frame(message) and (
            self._held[0].log_time_ns < message.log_time_ns - _HELD_NS or self._held_bytes > self._limit_bytes
        ):
            old = self._take()
            if not _is_frame(old):
                self._log.put(old)

    def flush(self) -> None:
        """Hand to the disk what is written."""
        self._log.flush()

    def sync(self, confirm: Confirm) -> None:
        """Sync the flushed messages to the disk, and ``confirm`` it."""
        self._log.sync(confirm)

    def _write(self, since_ns: int | None = None) -> None:
        """Write all that is held; of the frames those taken since then, None for none."""
        while self._held:
            message = self._take()
            if not _is_frame(message) or (since_ns is not None and message.publish_time_ns >= since_ns):
                self._log.put(message)

    def _take(self) -> Message:
        message = self._held.popleft()
        self._held_bytes -= _bytes_of(message)
        return message


def _bytes_of(message: Message) -> int:
    return len(message.payload.data) if _is_frame(message) else 0


def _is_frame(message: Message) -> bool:
    return isinstance(message.payload, CompressedImage)
