"""Resets: instants at which a stage clears its memory of a camera, at absolute multiples of a period.

The instants depend on the log time and the name of the camera only. So a cut or a merge keeps them, and the
frames of a camera between two resets can be processed without the frames before them.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Resets:
    """The resets of all cameras.

    Parameters
    ----------
    period_ns : time between two resets of a camera.
    shift_ns : time that merges have added to the log times since the resets were fixed.

    Examples
    --------
    >>> resets = Resets(30_000_000_000)
    >>> number = resets.number("red", 1_700_000_000_000_000_000)
    >>> resets.start_ns("red", number) <= 1_700_000_000_000_000_000 < resets.start_ns("red", number + 1)
    True
    """

    period_ns: int
    shift_ns: int = 0

    def number(self, camera: str, log_time_ns: int) -> int:
        """Return the number of the last reset of a camera at or before a log time in ns."""
        return (log_time_ns - self._first_ns(camera)) // self.period_ns

    def start_ns(self, camera: str, number: int) -> int:
        """Return the log time in ns of a reset of a camera."""
        return self._first_ns(camera) + number * self.period_ns

    def _first_ns(self, camera: str) -> int:
        # Simultaneous searches of all cameras would take too long for live tracking. The name of a camera,
        # unlike its number in the rig, stays the same in all parts of a log.
        return self.shift_ns + (zlib.crc32(camera.encode()) * self.period_ns >> 32)
