"""The size that a recording will have, and how long the disk lasts."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ipsys_log.capture.camera_thread import CameraState
from ipsys_log.capture.full_disk import reserved_bytes
from ipsys_log.messages import RigCamera
from ipsys_log.units import format_bytes, format_duration

__all__ = ["SHORT_S", "DiskRoom", "expected_bytes_per_s", "free_room"]

# Warn of a disk that lasts no longer.
SHORT_S = 600.0
# From this rate on, advise how to make the recording smaller.
_LARGE_BYTES_PER_S = 500e6 / 60
_USUAL_RATE_HZ = 30.0
# H.264 of cameras takes some 6 Mbit/s at 1920 x 1080 and 30 frames/s. A first frame tells little of it.
_VIDEO_BYTES_PER_PX = 0.0125


@dataclass(frozen=True, slots=True)
class DiskRoom:
    """Free disk space for a recording, and the rate at which it fills.

    Attributes
    ----------
    folder : of the recording.
    free_bytes : space for the recording.
    bytes_per_s : of all cameras; 0 if it is not known.
    """

    folder: Path
    free_bytes: int
    bytes_per_s: float

    @property
    def lasts_s(self) -> float | None:
        """Seconds until the disk is full; None if the rate is not known."""
        return self.free_bytes / self.bytes_per_s if self.bytes_per_s > 0 else None

    def is_short(self, seconds: float | None = None) -> bool:
        """Return whether the disk is full before ``seconds``, or before 10 minutes if no end is set."""
        return self.lasts_s is not None and self.lasts_s < (SHORT_S if seconds is None else seconds)

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
        lasts = format_duration(self.lasts_s or 0.0)
        ends = f"full after {lasts}" if self.is_short(seconds) else f"enough for {lasts}"
        return f"about {size}; {format_bytes(self.free_bytes)} free in {self.folder}: {ends}"

    def advise(self, cameras: Iterable[RigCamera], states: Mapping[str, CameraState]) -> str | None:
        """Return advice to make a recording smaller; None if it is small and the disk lasts."""
        if self.bytes_per_s < _LARGE_BYTES_PER_S and not self.is_short():
            return None
        rate_hz = max((camera.rate_hz or _USUAL_RATE_HZ for camera in cameras), default=_USUAL_RATE_HZ)
        ways = [f"a lower rate_hz in lab.toml ({rate_hz / 2:g} halves it)", "a smaller width and height"]
        if any(state.format == "jpeg" for state in states.values()):
            ways.append("a lower JPEG quality or H.264, where the camera can")
        ways.append("ipsys measure, which keeps only a second of each place")
        return "to make it smaller: " + "; ".join(ways)


def expected_bytes_per_s(cameras: Iterable[RigCamera], states: Mapping[str, CameraState]) -> float:
    """Estimate the data rate of cameras from their first frames and the rates in the rig.

    Parameters
    ----------
    cameras : a camera without a rate is assumed to send 30 frames/s.
    states : of the cameras, by name, once each has sent a frame.

    Examples
    --------
    >>> state = CameraState(frames=1, bytes=200_000, format="jpeg", size_px=(1920, 1080))
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
    return state.bytes / state.frames if state.frames else 0.0
