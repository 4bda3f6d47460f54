"""The repeated frames of a live simulated camera, rendered one by one while they are shown."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass

from ipsys_log.calibration.board import Board
from ipsys_log.simulation.board import hold_board
from ipsys_log.simulation.calibration_points import place
from ipsys_log.simulation.cameras import hang_cameras
from ipsys_log.simulation.floor import Check
from ipsys_log.simulation.lab import driving
from ipsys_log.simulation.live_lab import LiveLab, plan_live_lab
from ipsys_log.simulation.render import Print, encode_jpeg, lay_down, render
from ipsys_log.simulation.seeds import Purpose, stream
from ipsys_log.simulation.settings import LabSettings
from ipsys_log.simulation.views import View, prepare_view

__all__ = ["Film", "board_film", "lab_film", "next_missing", "shown_at"]

# Duration of each pose of a board.
_HOLD_S = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """Pictures of a camera, and the picture of each frame.

    ``draw`` makes the JPEG picture of an index from 0 to ``count``; ``index_of`` tells the index for the
    number of a frame since 1970, so that all cameras of a lab agree. It repeats after ``period`` frames.
    """

    count: int
    period: int
    draw: Callable[[int], bytes]
    index_of: Callable[[int], int]


def lab_film(settings: LabSettings, number: int, check: Check) -> Film:
    """Return the film of one camera of the live lab, with stationary markers and driving ones.

    Parameters
    ----------
    settings : of the lab; the robots drive for ``drive_s`` in one direction.
    number : which of its cameras.
    check : called between the steps; its exceptions end the work.
    """
    lab = plan_live_lab(settings)
    count = max(round(settings.drive_s * settings.rate_hz), 1)
    check()
    bare = prepare_view(hang_cameras(settings)[number], settings, check)
    view = lay_down(bare, [place(where, settings) for where in lab.lying], settings)

    def draw(index: int) -> bytes:
        return _picture(view, _driving(lab, index), settings, number, index)

    return Film(count, max(2 * count - 2, 1), draw, lambda frame: shown_at(frame, count))


def board_film(settings: LabSettings, number: int, board: Board, check: Check) -> Film:
    """Return the film of a camera with a calibration board, in one pose after the other.

    Parameters
    ----------
    settings, number, check : as for :func:`lab_film`.
    board : what is held.
    """
    camera = hang_cameras(settings)[number]
    poses = hold_board(board, camera, settings)
    view = prepare_view(camera, settings, check)
    held = max(round(_HOLD_S * settings.rate_hz), 1)

    def draw(index: int) -> bytes:
        return _picture(view, [poses[index]], settings, number, index)

    return Film(len(poses), len(poses) * held, draw, lambda frame: frame // held % len(poses))


def shown_at(frame: int, count: int) -> int:
    """Return which of ``count`` pictures a frame shows, by its number: to and fro.

    Examples
    --------
    >>> [shown_at(frame, 4) for frame in range(8)]
    [0, 1, 2, 3, 2, 1, 0, 1]
    """
    turn = frame % max(2 * count - 2, 1)
    return min(turn, 2 * count - 2 - turn)


def next_missing(film: Film, drawn: Container[int], frame: int) -> int | None:
    """Return the index of the next picture that is shown from a frame on and not drawn; None if all are.

    Examples
    --------
    >>> film = Film(4, 6, lambda index: b"", lambda frame: shown_at(frame, 4))
    >>> next_missing(film, {2, 3}, 2), next_missing(film, {0, 1, 2, 3}, 2)
    (1, None)
    """
    indices = (film.index_of(number) for number in range(frame, frame + film.period))
    return next((index for index in indices if index not in drawn), None)


def _driving(lab: LiveLab, index: int) -> list[Print]:
    time_s = index / lab.settings.rate_hz
    return [driving(lab.drive, marker_id, time_s, lab.settings) for marker_id in lab.drive.ahead_s]


def _picture(view: View, prints: list[Print], settings: LabSettings, number: int, index: int) -> bytes:
    rng = stream(settings.seed, Purpose.FRAME, number, index)
    return encode_jpeg(render(view, prints, settings, rng), settings)
