"""Buffer of recent frames: the log gets the frames around a measurement; other frames are discarded."""

from __future__ import annotations

from collections import deque
from types import TracebackType

from ipsys_log.capture.disk import Confirm
from ipsys_log.capture.recorder import Recording
from ipsys_log.errors import WriteError
from ipsys_log.messages import FRAME_SKIPPED, CompressedImage, Event, Measurement, Message
from ipsys_log.units import NS_PER_S

# Longer than the stationary interval of a measurement and the delay of the stages.
BUFFER_NS = 5 * NS_PER_S
# Eight cameras at 60 frames/s send less in two seconds. Beyond this limit, a calibration point gets only the
# frames that the buffer still holds.
_LIMIT_BYTES = 256 << 20
# Longest time from the time of a frame to the exposure of a marker in it (rolling shutter).
_ROLLING_NS = NS_PER_S // 10


class RecentFrames:
    """A buffer of the last messages of a recording. A context manager: on leaving, it writes the rest.

    Messages enter and leave in the order of log times. A frame is discarded after some seconds, or earlier
    if the buffer is full. Any other message is written then. A measurement is written at once. Before it,
    the buffer writes the frames since the start of the marker's stationary interval. Their order is the same
    as in a full recording.

    Parameters
    ----------
    log : recording that gets the messages.
    limit_bytes : most bytes of frames in the buffer.
    """

    def __init__(self, log: Recording, limit_bytes: int = _LIMIT_BYTES) -> None:
        self._log = log
        self._limit_bytes, self._buffer_bytes = limit_bytes, 0
        self._buffer: deque[Message] = deque()

    def __enter__(self) -> RecentFrames:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not isinstance(error, (WriteError, KeyboardInterrupt)):
            self._write()

    @property
    def is_deleted(self) -> bool:
        return self._log.is_deleted

    @property
    def full(self) -> WriteError | None:
        return self._log.full

    @property
    def fault(self) -> OSError | None:
        return self._log.fault

    def put(self, message: Message) -> None:
        """Append the next message of a recording.

        Raises
        ------
        WriteError
            The disk is full.
        """
        payload = message.payload
        # The event tells a replay which frames have no live results. This log holds no live results.
        if isinstance(payload, Event) and payload.kind == FRAME_SKIPPED:
            return
        self._buffer.append(message)
        self._buffer_bytes += _bytes_of(message)
        if isinstance(payload, Measurement):
            self._write(None if payload.still is None else payload.still.start - _ROLLING_NS)
        while _is_frame(message) and (
            self._buffer[0].log_time_ns < message.log_time_ns - BUFFER_NS
            or self._buffer_bytes > self._limit_bytes
        ):
            oldest = self._take()
            if not _is_frame(oldest):
                self._log.put(oldest)

    def flush(self) -> None:
        """Flush the written messages to the operating system."""
        self._log.flush()

    def sync(self, confirm: Confirm) -> None:
        """Sync the flushed messages to the disk, and ``confirm`` it."""
        self._log.sync(confirm)

    def _write(self, since_ns: int | None = None) -> None:
        """Write all messages of the buffer; of the frames, only those since ``since_ns`` (None: no frame)."""
        while self._buffer:
            message = self._take()
            if not _is_frame(message) or (since_ns is not None and message.publish_time_ns >= since_ns):
                self._log.put(message)

    def _take(self) -> Message:
        message = self._buffer.popleft()
        self._buffer_bytes -= _bytes_of(message)
        return message


def _bytes_of(message: Message) -> int:
    return len(message.payload.data) if _is_frame(message) else 0


def _is_frame(message: Message) -> bool:
    return isinstance(message.payload, CompressedImage)
