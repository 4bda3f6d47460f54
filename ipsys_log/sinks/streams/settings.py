"""The streams of a command: their settings, their check before any work, and the open streams."""

import secrets
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, field, fields
from itertools import chain
from math import pi
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from ipsys_log.capture.lab import OpenLab
from ipsys_log.extras import check_installed
from ipsys_log.messages import RigStream
from ipsys_log.messages.channels import TRACKS
from ipsys_log.sinks.sink import InlineSink, Warn
from ipsys_log.sinks.streams.poses import STALE_S, PoseSource, first_session
from ipsys_log.sinks.streams.udp import UdpStream, read_key
from ipsys_log.sinks.streams.vrpn import PORT, VrpnStream

# The usual port of each server.
PORTS = {"vrpn": PORT, "ros2": 7447, "foxglove": 8765}
_SECRET_BYTES = 12


class Stream(InlineSink, Protocol):
    """A sink with open sockets that never waits; one with connections also has a ``client_count``."""

    @property
    def dropped_count(self) -> int:
        """The number of messages that the stream lost."""

    def describe(self) -> str:
        """Return one line about the receivers of the positions."""

    def close(self) -> None:
        """Close the sockets."""


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """The streams to open: the fields of `RigStream`, and those of the command line.

    Attributes
    ----------
    key : the path of the key file.
    images : Foxglove and Rerun show images, too.
    rerun : show positions in Rerun, in a browser of this machine.
    secret : the token in the address for Foxglove, new in each program.
    """

    host: str | None = None
    udp: tuple[str, ...] = ()
    key: Path | None = None
    vrpn: int | None = None
    mavlink: tuple[str, ...] = ()
    north_rad: float = pi / 2
    robots: tuple[str, ...] = ()
    stale_s: float = STALE_S
    ros2: int | None = None
    ros2_domain: int = 0
    foxglove: int | None = None
    images: bool = False
    rerun: bool = False
    secret: str = field(default_factory=lambda: secrets.token_urlsafe(_SECRET_BYTES))

    @property
    def named_robots(self) -> tuple[str, ...]:
        """The robots that the settings name."""
        return (*self.robots, *(text.partition("=")[0] for text in self.mavlink if "=" in text))

    def __bool__(self) -> bool:
        servers = (self.vrpn, self.ros2, self.foxglove)
        return bool(self.udp or self.mavlink or self.rerun) or any(port is not None for port in servers)

    @property
    def has_viewer(self) -> bool:
        """True if a person watches: a viewer shows more than positions."""
        return self.rerun or self.foxglove is not None


def settings_of_rig(stream: RigStream | None, folder: Path) -> StreamSettings:
    """Return the settings of a rig file; the path of its key is relative to the folder of the file."""
    if stream is None:
        return StreamSettings()
    given = {field.name: getattr(stream, field.name) for field in fields(stream)}
    given["key"] = None if stream.key is None else folder / stream.key
    return StreamSettings(**{name: value for name, value in given.items() if value is not None})


@contextmanager
def open_streams(
    settings: StreamSettings,
    topics: Collection[str],
    now_ns: Callable[[], int],
    warn: Warn,
    session: int | None = None,
    heights_m: Mapping[str, float | None] = MappingProxyType({}),
    is_replayed: bool = False,
) -> Iterator[list[Stream]]:
    """Open streams; their sockets are closed after the block.

    Parameters
    ----------
    topics : the topics of the tracks.
    now_ns : the clock of the ages.
    warn : makes an event for lost messages.
    session : the number of the first session; None: from the clock.
    heights_m : all robots of the rig, announced before they are seen, with the heights of their markers
        (None: unknown).
    is_replayed : the times are those of a recording.

    Raises
    ------
    IpsysError
        An address, a port or the key has a fault.
    """
    number = first_session(now_ns()) if session is None else session

    def poses(named: Collection[str] = settings.robots) -> PoseSource:
        return PoseSource(topics, now_ns, number, named, settings.stale_s)

    key = None if settings.key is None else read_key(settings.key)
    sent_m = {name: m for name, m in heights_m.items() if not settings.robots or name in settings.robots}
    with ExitStack() as stack:
        streams: list[Stream] = []
        for target in dict.fromkeys(settings.udp):
            stream = UdpStream(target, settings.host, poses(), warn, key)
            streams.append(stack.enter_context(closing(stream)))
        if settings.vrpn is not None:
            server = VrpnStream(settings.vrpn, settings.host, poses(), warn, list(sent_m))
            streams.append(stack.enter_context(closing(server)))
        for other in chain(
            _autopilots(settings, poses, now_ns, warn),
            _ros2_nodes(settings, poses(), now_ns, warn, sent_m, is_replayed),
            _foxglove_servers(settings, number, topics, warn, is_replayed),
        ):
            streams.append(stack.enter_context(closing(other)))
        yield streams


def open_live_streams(
    settings: StreamSettings, lab: OpenLab, run: str
) -> AbstractContextManager[list[Stream]]:
    """Open streams of the tracks of a run, for the robots of an open lab."""
    cameras = lab.cameras
    return open_streams(
        settings,
        {TRACKS.topic_of(run)},
        cameras.clock.now_ns,
        cameras.add_event,
        heights_m=lab.rig.robot_heights_m(),
    )


def _autopilots(
    settings: StreamSettings,
    poses: Callable[[Collection[str]], PoseSource],
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


def _ros2_nodes(
    settings: StreamSettings,
    poses: PoseSource,
    now_ns: Callable[[], int],
    warn: Warn,
    heights_m: Mapping[str, float | None],
    is_replayed: bool,
) -> Iterator[Stream]:
    """Yield the stream to ROS 2, if there is one; its libraries are optional, and loaded only here."""
    if settings.ros2 is not None:
        check_installed("--ros2 needs", "zenoh", "rosbags", "xxhash")
        from ipsys_log.sinks.streams.ros2 import Ros2Stream

        where = (settings.ros2, settings.ros2_domain, settings.host)
        yield Ros2Stream(*where, poses, now_ns, warn, heights_m, is_replayed)


def _foxglove_servers(
    settings: StreamSettings, session: int, topics: Collection[str], warn: Warn, is_replayed: bool
) -> Iterator[Stream]:
    """Yield the server for Foxglove, if there is one; its library is optional, and loaded only here."""
    if settings.foxglove is not None:
        check_installed("--foxglove needs", "websockets")
        from ipsys_log.sinks.streams.foxglove import FoxgloveStream

        where = (settings.foxglove, settings.host, settings.secret)
        yield FoxgloveStream(*where, session, topics, warn, settings.images, is_replayed)


def check_streams(settings: StreamSettings) -> list[str]:
    """Open all sockets and close them again; return a line for each stream about its receivers.

    Raises
    ------
    IpsysError
        The errors of :func:`open_streams`.
    """
    with open_streams(settings, (), lambda: 0, lambda kind, text: None, 0) as streams:
        return [stream.describe() for stream in streams]
