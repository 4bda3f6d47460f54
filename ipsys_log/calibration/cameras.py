"""The lenses of all cameras that saw a board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from ipsys_log.calibration.boards import Board
from ipsys_log.calibration.calibrate import Calibrated, calibrate
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.look import NotSeenError, look
from ipsys_log.calibration.pictures import Pictures

__all__ = ["calibrate_cameras"]


def calibrate_cameras(
    sources: Sequence[Pictures],
    board: Board,
    model: LensModel,
    progress: Callable[[str, int, int | None], None] = lambda stage, done, total: None,
) -> tuple[list[Calibrated], list[str]]:
    """Calibrate each camera that saw the board.

    Parameters
    ----------
    sources : the pictures of each camera.
    board, model : what to look for, and the kind of lens.
    progress : called with the camera, the pictures done, and all of them.

    Returns
    -------
    The lenses, and why there is none of the other cameras.

    Raises
    ------
    IpsysError
        Where no camera saw the board, or one saw it too rarely.
    """
    found, unseen = [], []
    for pictures in sources:
        progress(pictures.camera, 0, pictures.looked_at or None)
        try:
            looked = look(
                pictures.read(), board, pictures.total, pictures.where,
                lambda done, of=pictures: progress(of.camera, done, of.looked_at or None),  # type: ignore[misc]
                partial(progress, "other boards"),
            )  # fmt: skip
        except NotSeenError as error:
            unseen.append(error)
            continue
        found.append(calibrate(pictures.camera, looked, board, model))
    if not found:
        raise unseen[0]
    return found, [str(error) for error in unseen]
