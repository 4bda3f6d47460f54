"""Options of the streams, which ``ipsys live`` and ``ipsys stream`` share."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ipsys_log.messages import Rig
    from ipsys_log.sinks.streams.settings import StreamSettings

# The options of the streams, by the names of `choose_streams`.
StreamOptions = dict[str, Any]

_PANEL = "Streams of positions"


def _port_option(name: str, text: str) -> Any:
    """Return the type of an option for a port."""
    option = typer.Option(name, metavar="PORT", min=1, max=65535, help=text, rich_help_panel=_PANEL)
    return Annotated[int | None, option]


Udp = Annotated[
    list[str] | None,
    typer.Option(
        "--udp",
        metavar="HOST:PORT",
        help="Send positions as JSON datagrams to this address; repeat it for several. 239.255.0.1:9870 is a "
        "multicast group. docs/streams.md has receivers in Python and for ESP32.",
        rich_help_panel=_PANEL,
    ),
]
Key = Annotated[
    Path | None,
    typer.Option(
        "--key",
        metavar="FILE",
        help="Sign the datagrams with the key in this file (HMAC-SHA256).",
        rich_help_panel=_PANEL,
    ),
]
Vrpn = Annotated[
    bool,
    typer.Option(
        "--vrpn",
        help="Serve positions over VRPN on port 3883, as a motion-capture system: for ROS 2, MATLAB, Unity.",
        rich_help_panel=_PANEL,
    ),
]
VrpnPort = _port_option("--vrpn-port", "Serve VRPN on another port.")
Mavlink = Annotated[
    list[str] | None,
    typer.Option(
        "--mavlink",
        metavar="ROBOT=HOST:PORT",
        help="Send the pose of a robot to its autopilot (PX4, ArduPilot); repeat it for several. With "
        "/vision at the end, the message is VISION_POSITION_ESTIMATE instead of ODOMETRY.",
        rich_help_panel=_PANEL,
    ),
]
Ros2 = Annotated[
    bool,
    typer.Option(
        "--ros2",
        help="Publish positions to nodes of ROS 2 with rmw_zenoh, without ROS on this machine: /tf, and a "
        "pose and odometry for each robot.",
        rich_help_panel=_PANEL,
    ),
]
Ros2Port = _port_option(
    "--ros2-port", "Use the Zenoh router on this port instead of 7447; if none answers, ipsys is the router."
)
Ros2Domain = Annotated[
    int | None,
    typer.Option(
        "--ros2-domain",
        metavar="ID",
        help="Publish to this domain ID of ROS 2. Default: 0.",
        rich_help_panel=_PANEL,
    ),
]
Foxglove = Annotated[
    bool,
    typer.Option(
        "--foxglove",
        help="Serve positions to Foxglove on port 8765. The printed address has a new secret at each start.",
        rich_help_panel=_PANEL,
    ),
]
FoxglovePort = _port_option("--foxglove-port", "Serve Foxglove on another port.")
RerunPage = Annotated[
    bool,
    typer.Option(
        "--rerun",
        help="Show positions in Rerun, in a browser of this machine.",
        rich_help_panel=_PANEL,
    ),
]
Images = Annotated[
    bool,
    typer.Option("--images", help="Show images, too, in Foxglove and in Rerun.", rich_help_panel=_PANEL),
]
StreamHost = Annotated[
    str | None,
    typer.Option(
        "--host",
        metavar="ADDRESS",
        help="Let streams leave this machine: its address in the network, or 0.0.0.0 for all its addresses. "
        "The dashboard of --web is then open to the network, too. Default: only this machine.",
        rich_help_panel=_PANEL,
    ),
]
Robots = Annotated[
    list[str] | None,
    typer.Option(
        "--robot",
        metavar="NAME",
        help="Send only this robot; repeat it for several. Default: all.",
        rich_help_panel=_PANEL,
    ),
]


# Each option with its type, its default, and its name for `choose_streams`.
_OPTIONS: dict[str, tuple[Any, Any, str]] = {
    "udp": (Udp, None, "udp"),
    "key": (Key, None, "key"),
    "vrpn": (Vrpn, False, "is_vrpn"),
    "vrpn_port": (VrpnPort, None, "vrpn"),
    "mavlink": (Mavlink, None, "mavlink"),
    "ros2": (Ros2, False, "is_ros2"),
    "ros2_port": (Ros2Port, None, "ros2"),
    "ros2_domain": (Ros2Domain, None, "ros2_domain"),
    "foxglove": (Foxglove, False, "is_foxglove"),
    "foxglove_port": (FoxglovePort, None, "foxglove"),
    "rerun": (RerunPage, False, "rerun"),
    "images": (Images, False, "images"),
    "host": (StreamHost, None, "host"),
    "robot": (Robots, None, "robots"),
}


def takes_streams(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of the streams, in place of its keyword ``streams``."""
    signature = inspect.signature(command, eval_str=True)
    parameters = [p for own in signature.parameters.values() for p in _expand(own)]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        streams = {name: given.pop(option) for option, (_, _, name) in _OPTIONS.items()}
        command(**given, streams=streams)

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def _expand(parameter: inspect.Parameter) -> Iterator[inspect.Parameter]:
    if parameter.name != "streams":
        yield parameter
        return
    for option, (kind, default, _) in _OPTIONS.items():
        yield inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def choose_streams(
    rig: Rig | None, folder: Path, *, has_page: bool = False, **options: Any
) -> StreamSettings:
    """Return the streams of the options; where an option is missing, those of the rig file.

    Parameters
    ----------
    rig : the rig of a file, never of a log: a log opens no socket.
    folder : the folder of the rig file.
    has_page : the command also serves a page at the address of ``host``.
    options : fields of `StreamSettings`, and ``is_vrpn``, ``is_ros2`` and ``is_foxglove`` for the usual
        port; None, False and empty lists are missing.

    Raises
    ------
    IpsysError
        There is no stream for an option, or the rig has no such robot.
    """
    from ipsys_log.rig.file import check_robots
    from ipsys_log.sinks.streams.settings import PORTS, settings_of_rig

    for name, port in PORTS.items():
        if options.pop(f"is_{name}", False):
            options[name] = options.get(name) or port
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in options.items()
        if value is not None and value is not False and value != []
    }
    settings = replace(settings_of_rig(None if rig is None else rig.stream, folder), **given)
    _check_effect(given.keys() - {"host"} if has_page else given, settings)
    if rig is not None:
        check_robots(rig, settings.named_robots, "--robot")
    return settings


def _check_effect(given: Collection[str], settings: StreamSettings) -> None:
    """Check that each option belongs to a stream."""
    from ipsys_log.errors import IpsysError

    names = {"robots": "robot", "ros2_domain": "ros2-domain"}
    if given and not settings:
        name = names.get(next(iter(given)), next(iter(given)))
        raise IpsysError(f"--{name}: has no effect without a stream; add one, such as --udp 127.0.0.1:9870")
    if "ros2_domain" in given and settings.ros2 is None:
        raise IpsysError("--ros2-domain: has no effect without ROS 2; add --ros2")
    if "images" in given and not settings.has_viewer:
        raise IpsysError("--images: has no effect without a viewer; add --foxglove or --rerun")
