"""The disk of a recording: its remaining time, periodic sync, a full disk, and a file that is renamed."""

import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from ipsys_log.capture.frames import CameraState
from ipsys_log.errors import LogError, WriteError, is_full
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import RigCamera
from ipsys_log.plain_text import shell_words
from ipsys_log.units import NS_PER_S, format_bytes, format_duration

# A power cut loses the data of this time, of the second that waits to be written, and of a sync.
SYNC_EVERY_S = 2.0
# After an interrupt, a hanging disk delays the end by at most this time.
_LAST_S = 1.0

# The function is called with None when the earlier data are on the disk, or with the error of the disk.
Confirm = Callable[[OSError | None], None]


class Syncer:
    """A thread that syncs a file every few seconds, and at once on request. A context manager.

    The writing thread never waits for it: a long sync only delays the next one.

    Parameters
    ----------
    sync : syncs the data written before the call.
    every_s : time from the end of a sync to the start of the next sync.

    Attributes
    ----------
    fault : the error of the first failed sync; data written before this sync may be lost.
    """

    def __init__(self, sync: Callable[[], None], every_s: float = SYNC_EVERY_S) -> None:
        self.fault: OSError | None = None
        self._sync, self._every_s = sync, every_s
        self._asked: list[Confirm] = []
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="syncer", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(_LAST_S if isinstance(error, KeyboardInterrupt) else None)

    def soon(self, confirm: Confirm) -> None:
        """Request a sync, at once or after the running sync; the thread then calls ``confirm``."""
        with self._changed:
            self._asked.append(confirm)
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._ended, self._every_s)
                requests, self._asked = self._asked, []
                if self._ended and not requests:
                    return
            fault: OSError | None = None
            try:
                self._sync()
            except OSError as error:
                fault = error
                self.fault = self.fault or error
            for confirm in requests:
                confirm(fault)


# Disk space reserved to finish a log when the disk is full. The end of a log needs it for the waiting
# messages, for their results, and for the table of contents, which is written twice. The table has some
# MB after some hours. On a small disk, half of the free space is reserved.
_RESERVE_BYTES = 64 << 20


def reserved_bytes(free_bytes: int) -> int:
    """Return the part of the free bytes on a disk that is reserved for the end of a log."""
    return min(_RESERVE_BYTES, free_bytes // 2)


@contextmanager
def reserve(path: Path) -> Iterator[Callable[[], None]]:
    """Reserve disk space in an unnamed file; call the yielded function to release it."""
    with ExitStack() as resources:
        with suppress(OSError):  # the file system does not support it, or the disk is full already
            if hasattr(os, "O_TMPFILE"):
                fd = os.open(path.parent, os.O_TMPFILE | os.O_RDWR)
                resources.callback(os.close, fd)
                os.posix_fallocate(fd, 0, reserved_bytes(shutil.disk_usage(path.parent).free))
        yield resources.close


def describe_disk_full(path: Path, error: WriteError) -> str:
    """Describe a log that ended because the disk was full or failed."""
    try:
        with LogReader(path) as log:
            count, seconds = log.message_count, ((log.end_ns or 0) - (log.start_ns or 0)) / NS_PER_S
    except LogError:
        return str(error)
    cause = "the disk is full" if is_full(error.cause) else describe_disk_fault(error.cause)
    remedy = (
        "Free some space, or record to another disk" if is_full(error.cause) else "Record to another disk"
    )
    size = format_bytes(path.stat().st_size)
    return (
        f"{path}: {cause}; the recording has stopped. The log is complete up to this time: "
        f"{count} messages, {seconds:.1f} s, {size}. {remedy}"
    )


def describe_disk_failure(path: Path, fault: OSError) -> str:
    """Describe what to do with a log that may be incomplete on a failed disk."""
    return (
        f"{path}: {describe_disk_fault(fault)} during the recording; messages may be missing. To check the "
        f"log: ipsys repair {shell_words(path)}. Record to another disk"
    )


def describe_disk_fault(fault: OSError) -> str:
    """Describe a fault of the disk."""
    return f"the disk has failed ({fault.strerror})"


# The recorder warns if the disk is full before this time.
LOW_DISK_WARNING_S = 600.0


# From this rate on, the recorder gives advice to make the recording smaller.
_LARGE_BYTES_PER_S = 500e6 / 60


_USUAL_RATE_HZ = 30.0


# H.264 of a camera takes about 6 Mbit/s at 1920 x 1080 and 30 frames/s. The first frame, a keyframe, is
# much larger than the mean.
_VIDEO_BYTES_PER_PX = 0.0125


@dataclass(frozen=True, slots=True)
class DiskRoom:
    """Free disk space for a recording, and the rate at which it fills.

    Attributes
    ----------
    folder : folder of the recording.
    free_bytes : space for the recording.
    bytes_per_s : data rate of all cameras; 0 if it is not known.
    """

    folder: Path
    free_bytes: int
    bytes_per_s: float

    @property
    def remaining_s(self) -> float | None:
        """The time until the disk is full, in s; None if the rate is not known."""
        return self.free_bytes / self.bytes_per_s if self.bytes_per_s > 0 else None

    def is_short(self, seconds: float | None = None) -> bool:
        """Return whether the disk will be full within ``seconds``; within 10 minutes if no end is set."""
        return self.remaining_s is not None and self.remaining_s < (
            LOW_DISK_WARNING_S if seconds is None else seconds
        )

    def describe(self, seconds: float | None = None) -> str:
        """Describe the size of the recording, and how long the disk lasts.

        Parameters
        ----------
        seconds : duration of the recording; None if no end is set.

        Examples
        --------
        >>> DiskRoom(Path("/data"), 45_000_000_000, 25e6).describe()
        'about 1.5 GB a minute; 45.0 GB free in /data: enough for 30 minutes'
        >>> DiskRoom(Path("/data"), 1_000_000_000, 25e6).describe(60)
        'about 1.5 GB in 1 minute; 1.0 GB free in /data: full after 40 s'
        """
        if seconds is None:
            size = f"{format_bytes(round(60 * self.bytes_per_s))} a minute"
        else:
            size = f"{format_bytes(round(seconds * self.bytes_per_s))} in {format_duration(seconds)}"
        lasts = format_duration(self.remaining_s or 0.0)
        ends = f"full after {lasts}" if self.is_short(seconds) else f"enough for {lasts}"
        return f"about {size}; {format_bytes(self.free_bytes)} free in {self.folder}: {ends}"

    def advise(self, cameras: Iterable[RigCamera], states: Mapping[str, CameraState]) -> str | None:
        """Return advice to make a recording smaller; None if it is small and the disk lasts."""
        if self.bytes_per_s < _LARGE_BYTES_PER_S and not self.is_short():
            return None
        rate_hz = max((camera.rate_hz or _USUAL_RATE_HZ for camera in cameras), default=_USUAL_RATE_HZ)
        ways = [f"a lower rate_hz in lab.toml ({rate_hz / 2:g} halves it)", "a smaller width and height"]
        if any(state.format == "jpeg" for state in states.values()):
            ways.append("a lower JPEG quality or H.264, if the camera supports it")
        ways.append("ipsys record --measure --points-only, which keeps about 1 s of frames of each point")
        return "to use less disk space: " + "; ".join(ways)


def expected_bytes_per_s(cameras: Iterable[RigCamera], states: Mapping[str, CameraState]) -> float:
    """Estimate the data rate of cameras from their first frames and the rates in the rig.

    Parameters
    ----------
    cameras : a camera without a rate is assumed to send 30 frames/s.
    states : states of the cameras by name, after each camera has sent a frame.

    Examples
    --------
    >>> state = CameraState(first_bytes=200_000, format="jpeg", size_px=(1920, 1080))
    >>> expected_bytes_per_s([RigCamera("red", rate_hz=15.0)], {"red": state})
    3000000.0
    """
    return sum(
        _frame_bytes(states[camera.name]) * (camera.rate_hz or _USUAL_RATE_HZ)
        for camera in cameras
        if camera.name in states
    )


def free_room(target: Path, bytes_per_s: float) -> DiskRoom:
    """Return the free space for a log that does not exist yet."""
    folder = target.absolute().parent
    free_bytes = shutil.disk_usage(folder).free
    return DiskRoom(folder, free_bytes - reserved_bytes(free_bytes), bytes_per_s)


def _frame_bytes(state: CameraState) -> float:
    if state.format in ("h264", "h265") and state.size_px is not None:
        width, height = state.size_px
        return _VIDEO_BYTES_PER_PX * width * height
    return state.first_bytes
