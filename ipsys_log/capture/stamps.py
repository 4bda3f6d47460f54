"""The time at which a network camera says it took a frame."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from ipsys_log.capture.frames import Clock, Say
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    from av.packet import Packet
    from av.video.stream import VideoStream

__all__ = ["Stamps", "read_stamp"]

# A frame that is said to be older, or younger, comes from a camera whose clock is not ours.
_OLDEST_NS = NS_PER_S
_YOUNGEST_NS = -NS_PER_S // 20


class Stamps:
    """Stamps of one stream, as far as they are to be trusted, and what is to be said of that, once.

    Parameters
    ----------
    name : of the camera.
    clock : ours.
    say : told how the frames are stamped.
    patience : so many frames may come before the first stamp. RTSP's sender ties its stamps to a clock by
        reports, one every few seconds.
    """

    def __init__(self, name: str, clock: Clock, say: Say, patience: int = 1) -> None:
        self._name = name
        self._clock = clock
        self._say = say
        self._patience = patience
        self._stamped = False
        self._trusted: bool | None = None

    def of(self, packet: Packet[VideoStream]) -> int | None:
        """When a packet's frame was taken, in ns of UTC; None where that is not known."""
        time_ns, stamped, self._stamped = read_stamp(packet), self._stamped, packet.has_sidedata("prft")
        if not stamped:
            # FFmpeg gives the frame before the first that has a stamp that one's.
            time_ns = None
        if self._trusted is None:
            self._judge(time_ns)
        return time_ns if self._trusted else None

    def _judge(self, time_ns: int | None) -> None:
        if time_ns is None:
            self._patience -= 1
            if not self._patience:
                self._trusted = False
                self._say(
                    f"camera {self._name}: sends no capture stamps; its frames get their time of arrival"
                )
            return
        age_ns = self._clock.now_ns() - time_ns
        self._trusted = _YOUNGEST_NS <= age_ns <= _OLDEST_NS
        age = f"{abs(age_ns) / NS_PER_S:.3f} s {'behind' if age_ns >= 0 else 'ahead of'} ours"
        if self._trusted:
            self._say(
                f"camera {self._name}: frames have the camera's own stamps (RTCP), {age}; sync it by NTP"
            )
        else:
            self._say(f"camera {self._name}: its clock is {age}, so its stamps are not used; sync it by NTP")


def read_stamp(packet: Packet[VideoStream]) -> int | None:
    """The wall clock of the sender that goes with a packet, in ns since 1970; RTSP's comes by RTCP."""
    if not packet.has_sidedata("prft"):
        return None
    # AVProducerReferenceTime: int64 of microseconds, int of flags.
    wall_us: int = struct.unpack_from("=q", bytes(packet.get_sidedata("prft")))[0]
    return wall_us * 1000
