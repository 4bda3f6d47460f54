"""Attached cameras: ``ipsys cameras``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.cli.console import console, print_json
from ipsys_log.cli.options import AsJson
from ipsys_log.cli.signals import writes_nothing

if TYPE_CHECKING:
    from ipsys_log.capture.usb_bus import UsbCamera

_NONE = """no USB camera is attached
  for a network camera, put its address into lab.toml: source = "rtsp://..." or "http://..."
  without a camera, source = "sim:red" is a simulated one: ipsys init lab.toml --simulated"""


def add_commands(app: typer.Typer) -> None:
    app.command()(cameras)


@writes_nothing
def cameras(
    rig: Annotated[
        Path | None,
        typer.Option(
            "--rig", metavar="FILE", help="Check that USB is fast enough for the cameras of this rig."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the USB cameras with device, modes, bus and hub, and check that USB is fast enough for all.

    Without --rig, the check uses the largest mode of each camera. Network cameras are not listed."""
    from ipsys_log.capture.usb_bus import advise_bandwidth, list_demands
    from ipsys_log.errors import IpsysError
    from ipsys_log.rig.file import load_rig

    if sys.platform != "linux":
        raise IpsysError(
            "ipsys cameras: lists cameras only on Linux; on this system, write usb:0, usb:1 and so on"
        )
    from ipsys_log.capture.usb_bus import find_cameras

    attached = find_cameras()
    advice = advise_bandwidth(list_demands(attached, load_rig(rig) if rig else None))
    if as_json:
        print_json({"cameras": [_plain(camera) for camera in attached], "advice": advice})
        return
    for camera in attached:
        console.print(_describe(camera))
    if not attached:
        console.print(_NONE)
    for line in advice:
        console.print(line)


def _plain(camera: UsbCamera) -> dict[str, Any]:
    plug = camera.plug._asdict() if camera.plug else None
    return camera._asdict() | {"plug": plug, "modes": [mode._asdict() for mode in camera.modes]}


def _describe(camera: UsbCamera) -> str:
    lines = [f'{camera.name}: source = "usb:{camera.stable or camera.device}"']
    if camera.stable:
        lines.append(f"  {camera.device}")
    if camera.plug:
        bus, port, speed_mbit_s, hub, _ = camera.plug
        lines.append(f"  USB bus {bus}, port {port}, {speed_mbit_s:g} Mbit/s; hub: {hub}")
    rates: dict[tuple[str, int, int], list[float]] = {}
    for mode in camera.modes:
        rates.setdefault(mode[:3], []).append(mode.rate_hz)
    for (name, width, height), each in rates.items():
        text = ", ".join(f"{rate:.3g}" for rate in sorted(set(each), reverse=True))
        lines.append(f"  {name:<5}{width:>5} x {height:<5}{text} frames/s")
    if camera.fault:
        lines.append(f"  its modes cannot be read: {camera.fault}")
    return "\n".join(lines)
