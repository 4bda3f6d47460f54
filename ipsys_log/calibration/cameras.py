"""The intrinsics of several cameras, each estimated separately: a bad one does not affect the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_search import NotSeenError, check_sizes, look
from ipsys_log.calibration.calibrate import Calibrated, calibrate
from ipsys_log.calibration.images import Pictures
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.errors import IpsysError

__all__ = ["Failure", "calibrate_cameras"]

Progress = Callable[[str, int, int | None], None]


class Failure(NamedTuple):
    """A camera without a result: the reason in one line, and whether the user expects a result.

    No result is expected for a camera of a log that never shows the board, unless the user names it.
    """

    camera: str
    reason: str
    expected: bool


def calibrate_cameras(
    sources: Sequence[Pictures],
    board: Board,
    model: LensModel,
    progress: Progress = lambda stage, done, total: None,
    insist: bool = False,
) -> Iterator[Calibrated | Failure]:
    """Calibrate each camera, and yield its result as soon as it is ready.

    Parameters
    ----------
    sources : the pictures of each camera.
    board, model : the board to search for, and the lens model.
    progress : called with the camera, the number of pictures done, and their total.
    insist : accept the given board size, and poor results.
    """
    for pictures in sources:
        try:
            yield _calibrate_one(pictures, board, model, progress, insist)
        except IpsysError as error:
            expected = pictures.requested or not isinstance(error, NotSeenError)
            yield Failure(pictures.camera, str(error), expected)


def _calibrate_one(
    pictures: Pictures, board: Board, model: LensModel, progress: Progress, insist: bool
) -> Calibrated:
    camera, count = pictures.camera, pictures.looked_at or None
    progress(camera, 0, count)
    sizes = pictures.sizes()
    if sizes:
        check_sizes(sizes, pictures.where)
    looked = look(
        pictures.read(), board, pictures.total, pictures.where,
        lambda done: progress(camera, done, count),
        partial(progress, "other boards"),
        insist,
    )  # fmt: skip
    return calibrate(camera, looked, board, model, insist)
