"""A host with a camera that sends its frames to the centre: ``ipsys node``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.app.cli.console import say, warn
from ipsys_log.app.cli.open_cameras import check_target, open_cameras, prepare_lab
from ipsys_log.app.cli.options import Calibrations, Corners, Force, log_option, setting, switch
from ipsys_log.app.cli.signals import allow_interrupt, runs_until_stopped
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.plain_text import shell_words
from ipsys_log.units import format_time

if TYPE_CHECKING:
    from ipsys_log.capture.lab import Lab
    from ipsys_log.capture.nodes.network import NodeNetwork
    from ipsys_log.engine.request import Request

NodeLog = Annotated[
    Path | None,
    log_option(help="The log of this node. Default: the name of the camera and the time, in this folder."),
]


@runs_until_stopped
def node(
    rig: Annotated[
        Path, typer.Argument(metavar="FILE", help="The rig file, with the source of the camera.")
    ] = Path("lab.toml"),
    camera: Annotated[
        str, setting("--camera", "NAME", "The camera of this host; the node has its name.")
    ] = "",
    output: NodeLog = None,
    centre: Annotated[
        str | None, setting("--centre", "HOST:PORT", "The address of the centre, instead of the rig's.")
    ] = None,
    certificates: Annotated[
        Path | None,
        setting("--certificates", "FOLDER", "The folder of the certificates, instead of the rig's."),
    ] = None,
    detect: Annotated[
        bool, switch("--detect", "Detect the markers here, and send only the markers.")
    ] = False,
    calibration: Calibrations = None,
    corners: Corners = None,
    seconds: Annotated[
        float | None, setting("--seconds", "SECONDS", "Stop after this time.", min=0.1)
    ] = None,
    force: Force = False,
) -> None:
    """Record one camera of this host, and send its frames to the centre, until Ctrl-C.

    The centre is a recording on another machine, such as ipsys live, whose rig has the source zenoh:NAME. If
    the centre or the network is away, the node records on, and sends the missing frames afterwards.

    Examples

        ipsys node lab.toml --camera red         # on the host of this camera
        ipsys node lab.toml --camera red --centre 192.168.1.10:7449
        ipsys node lab.toml --camera red --detect     # send only the markers
    """
    allow_interrupt("stopped before the first frame was recorded; no log was written")
    from ipsys_log.capture.live_plan import check_start
    from ipsys_log.capture.nodes.centre import is_of_node
    from ipsys_log.capture.nodes.network import read_network
    from ipsys_log.engine.request import Request

    check_installed("node needs", "zenoh")
    if not camera:
        raise IpsysError(f"{rig}: name the camera of this host: ipsys node {shell_words(rig)} --camera NAME")
    if corners is not None and not detect:
        raise IpsysError(f"--corners {corners}: has no effect without --detect")
    lab = prepare_lab(rig, [camera], calibration, with_lenses=detect)
    if is_of_node(lab.cameras[0]):
        raise IpsysError(
            f"{rig}: camera {camera} has the source {lab.cameras[0].source}, which belongs to the centre; "
            "give the device of this host, such as usb:/dev/video0, in a rig file of the node"
        )
    network = read_network(lab.rig.nodes, lab.folder, centre, certificates)
    network.files_of(camera)
    target = output or _new_log(camera)
    check_target(target, force, lab.files)
    request = Request(corners=corners) if detect else None
    if request is not None:
        check_start(lab.rig, lab.names, lab.lenses, request, "detect")
    _send(lab, network, target, seconds, request, force)


def _new_log(camera: str) -> Path:
    """Return the name of a new log: the camera and the time, in UTC."""
    from ipsys_log.capture.frames import Clock

    digits = "".join(sign for sign in format_time(Clock().now_ns())[:19] if sign.isdigit())
    return Path(f"{camera}_{digits[:8]}_{digits[8:]}.mcap")


def _send(
    lab: Lab, network: NodeNetwork, target: Path, seconds: float | None, request: Request | None, force: bool
) -> None:
    """Record the camera and send its frames, or with a request their markers."""
    from ipsys_log import __version__
    from ipsys_log.capture.nodes.node import Node
    from ipsys_log.live_runs import pipeline

    camera = lab.names[0]
    with (
        open_cameras(lab, target, seconds) as (opened, status),
        Node(camera, network, __version__, target, opened.cameras.clock, say, request is not None) as sender,
    ):
        cameras, settings = opened.cameras, opened.settings
        if request is not None:
            pipeline.live(cameras, settings, target, request, "detect", [status, sender], force)
        else:
            pipeline.record(cameras, settings, target, [status, sender], force)
        left = sender.finish(not cameras.is_stopped)
    if left:
        warn(sender.describe_missing(left, status.log))
