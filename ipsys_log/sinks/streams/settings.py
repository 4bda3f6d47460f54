"""The streams of a command: their settings, their check before any work, and the open streams."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Protocol

from ipsys_log.extras import check_installed
from ipsys_log.messages import RigStream
from ipsys_log.sinks.sink import SelectiveSink, Warn
from ipsys_log.sinks.streams.poses import STALE_S, PoseSource, first_session
from ipsys_log.sinks.streams.udp import UdpStream, read_key
from ipsys_log.sinks.streams.vrpn import VrpnStream

__all__ = ["Stream", "StreamSettings", "check_streams", "open_streams", "settings_of_rig"]


class Stream(SelectiveSink, Protocol):
    """A sink with open sockets."""

    def describe(self) -> str:
        """Return one line about the receivers of the positions."""

    def close(self) -> None:
        """Close the sockets."""


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """The streams to open, as in `RigStream`; ``key`` is the path of the key file."""

    host: str | None = None
    udp: tuple[str, ...] = ()
    key: Path | None = None
    vrpn: int | None = None
    mavlink: tuple[str, ...] = ()
    north_rad: float = pi / 2
    robots: tuple[str, ...] = ()
    stale_s: float = STALE_S

    @property
    def named_robots(self) -> tuple[str, ...]:
        """The robots that the settings name."""
        return (*self.robots, *(text.partition("=")[0] for text in self.mavlink))

    def __bool__(self) -> bool:
        return bool(self.udp or self.mavlink) or self.vrpn is not None


def settings_of_rig(stream: RigStream | None, folder: Path) -> StreamSettings:
    """Return the settings of a rig file; the path of its key is relative to the folder of the file."""
    if stream is None:
        return StreamSettings()
    return StreamSettings(
        stream.host,
        stream.udp,
        None if stream.key is None else folder / stream.key,
        stream.vrpn,
        stream.mavlink,
        pi / 2 if stream.north_rad is None else stream.north_rad,
        stream.robots,
        STALE_S if stream.stale_s is None else stream.stale_s,
    )


@contextmanager
def open_streams(
    settings: StreamSettings,
    topics: Collection[str],
    now_ns: Callable[[], int],
    warn: Warn,
    session: int | None = None,
    robots: Sequence[str] = (),
) -> Iterator[Sequence[Stream]]:
    """Open streams; their sockets are closed after the block.

    Parameters
    ----------
    topics : the topics of the tracks.
    now_ns : the clock of the ages.
    warn : makes an event for lost messages.
    session : the number of the first session; None: from the clock.
    robots : all robots of the rig, announced before they are seen.

    Raises
    ------
    IpsysError
        An address, a port or the key has a fault.
    """
    number = first_session(now_ns()) if session is None else session

    def poses(named: Sequence[str] = settings.robots) -> PoseSource:
        return PoseSource(topics, now_ns, number, named, settings.stale_s)

    key = None if settings.key is None else read_key(settings.key)
    with ExitStack() as stack:
        streams: list[Stream] = []
        for target in dict.fromkeys(settings.udp):
            stream = UdpStream(target, settings.host, poses(), warn, key)
            streams.append(stack.enter_context(closing(stream)))
        if settings.vrpn is not None:
            named = [robot for robot in robots if not settings.robots or robot in settings.robots]
            server = VrpnStream(settings.vrpn, settings.host, poses(), warn, named)
            streams.append(stack.enter_context(closing(server)))
        for autopilot in _autopilots(settings, poses, now_ns, warn):
            streams.append(stack.enter_context(closing(autopilot)))
        yield streams


def _autopilots(
    settings: StreamSettings,
    poses: Callable[[Sequence[str]], PoseSource],
    now_ns: Callable[[], int],
    warn: Warn,
) -> Iterator[Stream]:
    """Yield a stream for each autopilot; its library is optional, and loaded only here."""
    if settings.mavlink:
        check_installed("--mavlink needs", "pymavlink")
        from ipsys_log.sinks.streams.mavlink import MavlinkStream, parse_endpoint

        for endpoint in [parse_endpoint(text) for text in dict.fromkeys(settings.mavlink)]:
            source = poses([endpoint.robot])
            yield MavlinkStream(endpoint, settings.host, source, now_ns, warn, settings.north_rad)


def check_streams(settings: StreamSettings) -> list[str]:
    """Open all sockets and close them again; return a line for each stream about its receivers.

    Raises
    ------
    IpsysError
        The errors of :func:`open_streams`.
    """
    with open_streams(settings, (), lambda: 0, lambda kind, text: None, 0) as streams:
        return [stream.describe() for stream in streams]
