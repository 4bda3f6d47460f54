"""Streams: sinks that send poses of robots to other programs, with their settings in one table.

A setting has its option of the command line. This module loads no stream, so that the help of a command
appears at once; :mod:`ipsys_log.sinks.streams.opening` loads a stream if its setting is given.
"""

import secrets
from dataclasses import dataclass, field
from math import pi
from pathlib import Path
from typing import Any, NamedTuple

# The streams in the order of their opening, each with its optional libraries. A stream has the name of its
# setting, and of its module in this package, whose function ``open_all`` opens it.
STREAMS: dict[str, tuple[str, ...]] = {
    "udp": (),
    "vrpn": (),
    "mavlink": ("pymavlink",),
    "ros2": ("zenoh", "rosbags", "xxhash"),
    "foxglove": ("websockets",),
}
# A robot of 0.26 m/s moves 13 cm in this time.
STALE_S = 0.5
_SECRET_BYTES = 12


class StreamOption(NamedTuple):
    """The option of a setting; its type is that of the setting.

    Attributes
    ----------
    metavar : name of its value in the help; "" for a flag.
    port, port_help : of a server: its usual port, and the help of the option for another port.
    name : None: that of the setting.
    """

    help: str
    metavar: str = ""
    port: int | None = None
    port_help: str = ""
    name: str | None = None


def _option(default: Any, help: str, *described: Any, **more: Any) -> Any:
    return field(default=default, metadata={"option": StreamOption(help, *described, **more)})


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings:
    """The streams to open: the fields of `RigStream`, and those of the command line.

    Attributes
    ----------
    key : the path of the key file.
    images : Foxglove and Rerun show images, too.
    rerun : show positions in Rerun, in a browser of this machine.
    secret : the token in the address for Foxglove, new in each program.
    """

    udp: tuple[str, ...] = _option(
        (),
        "Send positions as JSON datagrams to this address; repeat it for several. 239.255.0.1:9870 is a "
        "multicast group. docs/streams.md has receivers in Python and for ESP32.",
        "HOST:PORT",
    )
    key: Path | None = _option(  # noqa: RUF009 - it is a field
        None, "Sign the datagrams with the key in this file (HMAC-SHA256).", "FILE"
    )
    vrpn: int | None = _option(
        None,
        "Serve positions over VRPN on port 3883, as a motion-capture system: for ROS 2, MATLAB, Unity.",
        port=3883,
        port_help="Serve VRPN on another port.",
    )
    mavlink: tuple[str, ...] = _option(
        (),
        "Send the pose of a robot to its autopilot (PX4, ArduPilot); repeat it for several. With /vision at "
        "the end, the message is VISION_POSITION_ESTIMATE instead of ODOMETRY.",
        "ROBOT=HOST:PORT",
    )
    ros2: int | None = _option(
        None,
        "Publish positions to nodes of ROS 2 with rmw_zenoh, without ROS on this machine: /tf, and a pose "
        "and odometry for each robot.",
        port=7447,
        port_help="Use the Zenoh router on this port instead of 7447; if none answers, ipsys is the router.",
    )
    ros2_domain: int = _option(0, "Publish to this domain ID of ROS 2. Default: 0.", "ID")
    foxglove: int | None = _option(
        None,
        "Serve positions to Foxglove on port 8765. The printed address has a new secret at each start.",
        port=8765,
        port_help="Serve Foxglove on another port.",
    )
    rerun: bool = _option(False, "Show positions in Rerun, in a browser of this machine.")
    images: bool = _option(False, "Show images, too, in Foxglove and in Rerun.")
    host: str | None = _option(
        None,
        "Let streams leave this machine: its address in the network, or 0.0.0.0 for all its addresses. The "
        "dashboard of --web is then open to the network, too. Default: only this machine.",
        "ADDRESS",
    )
    robots: tuple[str, ...] = _option(
        (), "Send only this robot; repeat it for several. Default: all.", "NAME", name="--robot"
    )
    north_rad: float = pi / 2
    stale_s: float = STALE_S
    secret: str = field(default_factory=lambda: secrets.token_urlsafe(_SECRET_BYTES))

    @property
    def named_robots(self) -> tuple[str, ...]:
        """The robots that the settings name."""
        return (*self.robots, *(text.partition("=")[0] for text in self.mavlink if "=" in text))

    @property
    def wanted(self) -> list[str]:
        """The names of the streams to open, but Rerun."""
        return [name for name in STREAMS if getattr(self, name) not in (None, ())]

    def __bool__(self) -> bool:
        return self.rerun or bool(self.wanted)

    @property
    def has_viewer(self) -> bool:
        """True if a person watches: a viewer shows more than positions."""
        return self.rerun or self.foxglove is not None
