"""The simulated lab as live cameras: ``sim:red`` is its camera *red*, in real time."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from fractions import Fraction
from threading import Event, Thread, main_thread
from typing import NamedTuple
from urllib.parse import parse_qsl, urlencode

from ipsys_log.calibration.board import Board, parse_board
from ipsys_log.capture.frames import ActualSettings, Clock, Frame, Say, report_refused_settings, sleep_until
from ipsys_log.capture.simulation import live_lab
from ipsys_log.capture.simulation.cameras import Check, mount_cameras
from ipsys_log.capture.simulation.render import exposure_interval
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration, RigCamera
from ipsys_log.units import NS_PER_S

_LATENCY_NS = 4_000_000
# Squares of a board that a source names. Intrinsics do not depend on their size.
_SQUARE_M, _MARKER_SCALE, _DICTIONARY = 0.03, 0.75, "DICT_4X4_50"


class SimulatedCamera(NamedTuple):
    """The scene of a simulated camera: a lab, the number of its camera, and an optional board in front."""

    lab: LabSettings
    number: int
    board: Board | None = None


class _Stopped(Exception):  # noqa: N818
    """A signal to end the rendering: the images are not needed any more."""


class _Images:
    """The images of a film, rendered by a separate thread in the order of their use."""

    def __init__(
        self, name: str, make_film: Callable[[Check], live_lab.Film], timing: "FrameTiming", clock: Clock
    ) -> None:
        self._film: live_lab.Film | None = None
        self._drawn: dict[int, bytes] = {}
        self._fault: BaseException | None = None
        self._make_film, self._timing, self._clock = make_film, timing, clock
        self._stopped = Event()
        # Not a daemon: Python ends a daemon thread within a call of OpenCV, and the program aborts.
        Thread(target=self._work, name=f"draws {name}", daemon=False).start()

    def stop(self) -> None:
        self._stopped.set()

    def image(self, frame: int) -> bytes | None:
        """Return the image of a frame; None if it is not rendered yet."""
        if self._fault is not None:
            raise self._fault
        return None if self._film is None else self._drawn.get(self._film.index_of(frame))

    def _work(self) -> None:
        try:
            self._film = film = self._make_film(self._check)
            took_ns = 0
            while (index := live_lab.next_missing(film, self._drawn, self._frame_in(took_ns))) is not None:
                self._check()
                start_ns = self._clock.now_ns()
                self._drawn[index] = film.draw(index)
                took_ns = self._clock.now_ns() - start_ns
        except _Stopped:
            return
        except BaseException as fault:  # raised again in the thread that takes the frames
            self._fault = fault

    def _frame_in(self, later_ns: int) -> int:
        """Return the number of the first frame that is delivered later than ``later_ns`` from now."""
        return self._timing.frame_at(self._clock.now_ns() + later_ns) + 1

    def _check(self) -> None:
        # When the program ends, Python waits for this thread, also if no caller has stopped it.
        if self._stopped.is_set() or not main_thread().is_alive():
            raise _Stopped


@contextmanager
def open_simulated(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """Open a simulated camera; an :data:`~ipsys_log.capture.frames.Open`.

    Most markers of the lab are stationary; the others drive to and fro. With a board in the source, the
    camera sees this board instead. Each image is rendered once, by a separate thread, and shown repeatedly.
    A frame is skipped if its image is not rendered yet. The clock alone decides the image of a frame: all
    cameras of a lab see the robots at the same positions, in all processes.

    Parameters
    ----------
    camera : its ``source`` is ``sim:`` and the name of the camera in the lab. The source may have a board
        and the settings of ``ipsys simulate``: ``sim:red?seed=3&markers=5``, ``sim:red?board=6x4``. The
        rig gives size and rate.
    clock : decides the image of each frame.
    say : called with a description of the scene, and with each setting that is refused.
    """
    simulated = parse_source(camera)
    lab = simulated.lab
    report_refused_settings(camera, ActualSettings(lab.width, lab.height, lab.rate_hz), say)
    shown = "the simulated lab" if simulated.board is None else f"{simulated.board} in the simulated lab"
    say(f"camera {camera.name}: shows {shown}, {lab.width} x {lab.height} px, {lab.rate_hz:g} frames/s")
    timing = FrameTiming.of(lab, camera.stamp)

    def make_film(check: Check) -> live_lab.Film:
        if simulated.board is None:
            return live_lab.lab_film(lab, simulated.number, check)
        return live_lab.board_film(lab, simulated.number, simulated.board, check)

    images = _Images(camera.name, make_film, timing, clock)
    try:
        yield _play(images, timing, clock)
    finally:
        images.stop()


def parse_source(camera: RigCamera) -> SimulatedCamera:
    """Parse a source; return the lab, the camera, and the board in front of the camera.

    Examples
    --------
    >>> seat = parse_source(RigCamera("left", source="sim:white?seed=3&board=6x4", width=960, height=540))
    >>> seat.lab.seed, seat.lab.width, seat.lab.cameras[seat.number], str(seat.board)
    (3, 960, 'white', 'a chessboard of 6 x 4 inner corners')
    """
    name, _, query = (camera.source or "").partition(":")[2].partition("?")
    requested = {"width": camera.width, "height": camera.height, "rate_hz": camera.rate_hz}
    values: dict[str, int | float] = {key: value for key, value in requested.items() if value is not None}
    setting_types = {
        f.name: _parse_switch if isinstance(f.default, bool) else type(f.default)
        for f in fields(LabSettings)
        if isinstance(f.default, (int, float))
    }
    board = None
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key == "board":
            board = _parse_board(camera, text)
            continue
        if key not in setting_types:
            raise IpsysError(
                f"camera {camera.name}: the simulated lab has no setting {key!r}; "
                f"the settings are board, {', '.join(setting_types)}"
            )
        try:
            values[key] = setting_types[key](text)
        except ValueError as error:
            raise IpsysError(
                f"camera {camera.name}: {key}={text} is not a number; write {key}=1, for example"
                if setting_types[key] is not _parse_switch
                else f"camera {camera.name}: {key}={text} is no switch; write {key}=true or {key}=false"
            ) from error
    settings = replace(live_lab.LIVE_SETTINGS, **values)  # type: ignore[arg-type]
    if name not in settings.cameras:
        names = ", ".join(f"sim:{other}" for other in settings.cameras)
        raise IpsysError(
            f"camera {camera.name}: the simulated lab has no camera {name!r}; write one of {names}"
        )
    return SimulatedCamera(settings, settings.cameras.index(name), board)


def _parse_switch(text: str) -> bool:
    return bool(("false", "true").index(text))


def _parse_board(camera: RigCamera, text: str) -> Board:
    try:
        board = parse_board(text, _SQUARE_M, _MARKER_SCALE, _DICTIONARY, False)
        live_lab.board_cells(board)
    except IpsysError as error:
        raise IpsysError(f"camera {camera.name}: {str(error).replace('--board ', 'board=')}") from error
    return board


def show_board(camera: RigCamera, board: str) -> RigCamera:
    """Return a simulated camera with a board in front of it.

    A camera that is not simulated, or whose source has a board already, is returned unchanged.

    Examples
    --------
    >>> show_board(RigCamera("red", source="sim:red?seed=3"), "6x4").source
    'sim:red?seed=3&board=6x4'
    >>> show_board(RigCamera("red", source="usb:0"), "6x4").source
    'usb:0'
    """
    source = str(camera.source)
    if not source.startswith("sim:") or parse_source(camera).board is not None:
        return camera
    separator = "&" if "?" in source else "?"
    return replace(camera, source=f"{source}{separator}{urlencode({'board': board}, safe=':')}")


def intrinsics_of(camera: RigCamera) -> CameraCalibration:
    """Return the intrinsics of a simulated camera."""
    lab, number, _ = parse_source(camera)
    return replace(mount_cameras(lab)[number].lens, frame_id=camera.name)


class FrameTiming(NamedTuple):
    """The times at which frames are exposed, stamped and delivered."""

    # A float is not precise enough for times since 1970.
    period_ns: Fraction
    stamp_ns: int
    behind_ns: int

    @classmethod
    def of(cls, lab: LabSettings, stamp: str | None) -> "FrameTiming":
        # A driver stamps the start of the first row's exposure, or the end of the last row's exposure.
        start_s, end_s = exposure_interval(0, lab.height - 1, lab)
        stamp_ns = round({"start": start_s, "end": end_s}.get(stamp or "", 0.0) * NS_PER_S)
        return cls(NS_PER_S / Fraction(lab.rate_hz), stamp_ns, round(end_s * NS_PER_S) + _LATENCY_NS)

    def frame_at(self, now_ns: int) -> int:
        """Return the number of the last frame that is delivered at ``now_ns`` or before."""
        return math.floor((now_ns - self.behind_ns) / self.period_ns)


def _play(images: _Images, timing: FrameTiming, clock: Clock) -> Iterator[Frame | None]:
    frame = 0
    while True:
        # A late reader misses frames.
        frame = max(frame + 1, timing.frame_at(clock.now_ns()))
        time_ns = round(frame * timing.period_ns)
        yield from sleep_until(time_ns + timing.behind_ns, clock)
        data = images.image(frame)
        yield None if data is None else Frame(data, "jpeg", time_ns + timing.stamp_ns)
