"""The simulated lab as live cameras: ``sim:red`` is its camera *red*, in real time."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import fields, replace
from fractions import Fraction
from threading import Event, Thread
from urllib.parse import parse_qsl

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration, RigCamera
from ipsys_log.sources.asked import Given, say_refused
from ipsys_log.sources.frames import Clock, Frame, Say
from ipsys_log.sources.simulator.cameras import hang_cameras
from ipsys_log.sources.simulator.drive import plan_drive
from ipsys_log.sources.simulator.render import encode_jpeg, render
from ipsys_log.sources.simulator.seeds import Purpose, stream
from ipsys_log.sources.simulator.settings import LabSettings
from ipsys_log.sources.simulator.shutter import exposed
from ipsys_log.sources.simulator.simulate import driving
from ipsys_log.sources.simulator.views import prepare_view
from ipsys_log.units import NS_PER_S

__all__ = ["lab_of", "lens_of", "open_simulated", "shown_at"]

_TURN_S = 0.4
_LATENCY_NS = 4_000_000
# A frame of 1920 x 1080 takes 50 ms to draw: so much of the drive is drawn beforehand.
_LOOP_S = 2.0


@contextmanager
def open_simulated(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """The frames of a simulated camera, as :data:`~ipsys_log.sources.frames.Open` says.

    The first 2 s of the robots' drive are drawn once, then shown to and fro for ever. Which frame is shown
    follows from the clock alone: all cameras of a lab see the robots at the same places, in whatever process.

    Parameters
    ----------
    camera : its ``source`` is ``sim:`` and the name of the camera in the lab, and may set what
        ``ipsys simulate`` can: ``sim:red?seed=3&markers=5``. Size and rate are those of the rig.
    clock : tells which frame is shown.
    say : told when drawing begins.

    Raises
    ------
    IpsysError
        Where the lab has no such camera, or no such setting.
    """
    settings, number = lab_of(camera)
    say_refused(camera, Given(settings.width, settings.height, settings.rate_hz), say)
    say(f"camera {camera.name}: draws {_LOOP_S:g} s of the simulated lab, then shows them to and fro")
    stop = Event()
    drawn: Future[list[bytes]] = Future()

    def work() -> None:
        try:
            drawn.set_result(_draw(settings, number, stop))
        except BaseException as fault:  # raised again where the frames are taken
            drawn.set_exception(fault)

    # A daemon: who interrupts does not wait for what is drawn.
    Thread(target=work, name=f"draws {camera.name}", daemon=True).start()
    try:
        yield _play(drawn, settings, camera.stamp, clock)
    finally:
        stop.set()


def lab_of(camera: RigCamera) -> tuple[LabSettings, int]:
    """The lab that a source names, and which of its cameras.

    Raises
    ------
    IpsysError
        Where the lab has no such camera, or no such setting, or the value is none.

    Examples
    --------
    >>> lab, number = lab_of(RigCamera("left", source="sim:white?seed=3", width=960, height=540))
    >>> lab.seed, lab.width, lab.cameras[number]
    (3, 960, 'white')
    """
    name, _, query = (camera.source or "").partition(":")[2].partition("?")
    asked = {"width": camera.width, "height": camera.height, "rate_hz": camera.rate_hz}
    values: dict[str, int | float] = {key: value for key, value in asked.items() if value is not None}
    known = {f.name: type(f.default) for f in fields(LabSettings) if isinstance(f.default, (int, float))}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            raise IpsysError(
                f"camera {camera.name}: the simulated lab has no setting {key!r}: {', '.join(known)}"
            )
        try:
            values[key] = known[key](text)
        except ValueError as error:
            raise IpsysError(f"camera {camera.name}: {key}={text} is no number") from error
    settings = LabSettings(**values)  # type: ignore[arg-type]
    if name not in settings.cameras:
        names = ", ".join(f"sim:{other}" for other in settings.cameras)
        raise IpsysError(
            f"camera {camera.name}: the simulated lab has no camera {name!r}; write one of {names}"
        )
    return settings, settings.cameras.index(name)


def lens_of(camera: RigCamera) -> CameraCalibration:
    """The lens through which a simulated camera sees.

    Raises
    ------
    IpsysError
        Where there is no such camera in the simulated lab.
    """
    settings, number = lab_of(camera)
    return replace(hang_cameras(settings)[number].lens, frame_id=camera.name)


def shown_at(frame: int, count: int) -> int:
    """Which of ``count`` drawn frames the frame of a number shows: to and fro.

    Examples
    --------
    >>> [shown_at(frame, 4) for frame in range(8)]
    [0, 1, 2, 3, 2, 1, 0, 1]
    """
    turn = frame % max(2 * count - 2, 1)
    return min(turn, 2 * count - 2 - turn)


def _draw(settings: LabSettings, number: int, stop: Event) -> list[bytes]:
    cameras = hang_cameras(settings)
    drive = plan_drive(settings, cameras)
    view = prepare_view(cameras[number], settings)
    frames = []
    for index in range(max(round(_LOOP_S * settings.rate_hz), 1)):
        if stop.is_set():
            break
        prints = [driving(drive, marker, index / settings.rate_hz, settings) for marker in drive.ahead_s]
        picture = render(view, prints, settings, stream(settings.seed, Purpose.FRAME, number, index))
        frames.append(encode_jpeg(picture, settings))
    return frames


def _play(
    drawn: Future[list[bytes]], settings: LabSettings, stamp: str | None, clock: Clock
) -> Iterator[Frame | None]:
    while not wait([drawn], _TURN_S).done:
        yield None
    frames = drawn.result()
    # A driver stamps the start of the first row's exposure, or the end of the last one's.
    start_s, end_s = exposed(0, settings.height - 1, settings)
    stamp_ns = round({"start": start_s, "end": end_s}.get(stamp or "", 0.0) * NS_PER_S)
    behind_ns = round(end_s * NS_PER_S) + _LATENCY_NS
    # Times since 1970 are too long for floating point.
    period_ns = NS_PER_S / Fraction(settings.rate_hz)
    frame = 0
    while True:
        # Who comes late has missed some.
        frame = max(frame + 1, math.floor((clock.now_ns() - behind_ns) / period_ns))
        time_ns = round(frame * period_ns)
        while (left_s := (time_ns - (clock.now_ns() - behind_ns)) / NS_PER_S) > 0:
            time.sleep(min(left_s, _TURN_S))
            if left_s > _TURN_S:
                yield None
        yield Frame(frames[shown_at(frame, len(frames))], "jpeg", time_ns + stamp_ns)
