"""What a camera was asked for, and what it gives."""

from __future__ import annotations

from typing import NamedTuple

from ipsys_log.capture.frames import Say
from ipsys_log.messages import RigCamera

__all__ = ["Given", "device_of", "say_refused"]

# By so much may a number differ, relatively: 30000/1001 frames/s are 30.
_NEAR = 0.01


class Given(NamedTuple):
    """What a camera gives; None where it cannot be set, or of the rate, where it cannot be told."""

    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    exposure_s: float | None = None
    focus: float | None = None
    gain: float | None = None


def say_refused(camera: RigCamera, given: Given, say: Say) -> None:
    """Say, a line for each, what a camera gives other than the rig asks for.

    Parameters
    ----------
    camera : what is asked for; None stands for whatever the camera likes.
    given : what it gives.
    say : told of each difference.

    Examples
    --------
    >>> say_refused(RigCamera("red", rate_hz=60.0), Given(1920, 1080, 30.0), print)
    camera red: asked for 60 frames/s, gives 30
    """
    size = (camera.width or given.width, camera.height or given.height)
    if given.width and given.height and size != (given.width, given.height):
        text = " x ".join(str(side) for side in size)
        say(f"camera {camera.name}: asked for {text} px, gives {given.width} x {given.height}")
    rows = (
        ("frames/s", camera.rate_hz, given.rate_hz),
        ("s of exposure", camera.exposure_s, given.exposure_s),
        ("of focus", camera.focus, given.focus),
        ("of gain", camera.gain, given.gain),
    )
    for unit, asked, has in rows:
        if asked is None or (has is None and unit == "frames/s"):
            continue
        if has is None:
            say(f"camera {camera.name}: asked for {asked:g} {unit}, which it does not let us set")
        elif abs(asked - has) > _NEAR * max(abs(asked), abs(has)):
            say(f"camera {camera.name}: asked for {asked:g} {unit}, gives {has:g}")


def device_of(source: str) -> str:
    """The device that a source names.

    Examples
    --------
    >>> device_of("usb:2"), device_of("usb:/dev/v4l/by-id/red-camera")
    ('/dev/video2', '/dev/v4l/by-id/red-camera')
    """
    name = source.partition(":")[2]
    return f"/dev/video{name}" if name.isdecimal() else name
