"""The intrinsics of several cameras: each for itself, so that a bad one does not cost the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

from ipsys_log.calibration.boards import Board
from ipsys_log.calibration.calibrate import Calibrated, calibrate
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.look import NotSeenError, check_sizes, look
from ipsys_log.calibration.pictures import Pictures
from ipsys_log.errors import IpsysError

__all__ = ["Failure", "calibrate_cameras"]

Progress = Callable[[str, int, int | None], None]


class Failure(NamedTuple):
    """A camera without a result: the reason in one line, and whether the user expects a result.

    None is expected of a camera of a log that does not show the board at all, unless the user names it.
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
    """Calibrate each camera, and yield its result as soon as it is there.

    Parameters
    ----------
    sources : the pictures of each camera.
    board, model : what to look for, and the kind of lens.
    progress : called with the camera, the pictures done, and all of them.
    insist : whether to take the board for what it is said to be, and results that are poor.
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
